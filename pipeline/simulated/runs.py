"""The runs of one laboratory session: decays, steps, sine dwells, a sweep, a closed loop."""

from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.sampled_loop import StateFeedback
from pipeline.plant.simulate import (
    SETTLED,
    SETTLED_DWELL,
    dwell_frequencies,
    largest_motion,
    settling_wait,
    simulate_linear,
    steady_time,
)
from pipeline.simulated.bench import BenchRun, ReleasingHand, SimulatedBench

INPUT_DECIMALS = 5  # the input is set in steps of 10 µV, so that the log holds the applied input
FIGURE_FREQUENCY = 4.0  # Hz, the dwell of the paper's Figures 12-14

_LETTERS = "abcdefgh"
_REST = 0.5  # s of rest before a step of the input or of the set point


@dataclass(frozen=True, kw_only=True)
class SimulatedSession:
    """A bench, with the number and the length of the runs to record on it.

    Attributes
    ----------
    repeats : number of repeats of every decay and of every step size.
    n_dwells : approximate number of dwell frequencies.
    transients : whether every dwell is recorded from rest. If not, most dwells are recorded only
        after the transient, which gives smaller files.
    sweep_time : duration of the sweep, s.
    """

    bench: SimulatedBench
    repeats: int = 3
    n_dwells: int = 28
    transients: bool = True
    sweep_time: float = 20.0

    @property
    def chain(self) -> Chain:
        """The linear model of the carts."""
        return self.bench.chain

    @property
    def travel(self) -> float:
        """The intended motion of the carts, position units."""
        return self.bench.travel

    def clock(self, duration: float) -> Array:
        """Return sample times (n,) from 0 to about `duration`, s."""
        return self.bench.sample_time * np.arange(
            np.ceil(duration / self.bench.sample_time) + 1, dtype=np.float64
        )


def plan_decays(session: SimulatedSession, rng: np.random.Generator) -> list[BenchRun]:
    """Return several decays of each cart, released by hand while the other carts are held.

    Carts without a spring are skipped.
    """
    chain, runs = session.chain, []
    for cart in range(1, chain.n + 1):
        if chain.k[cart - 1] + chain.k[cart] == 0:
            continue
        decay_rate = chain.c[cart - 1] / (2 * chain.m[cart - 1])
        # After 4.5 time constants, 1.5 cm have become 7 counts.
        ringing = max(1.0, 4.5 / max(decay_rate, 4.5 / 8.0))  # s
        for repeat in range(session.repeats):
            side = 1 if rng.random() < 0.5 else -1
            hand = ReleasingHand(
                cart=cart,
                position=side * session.travel * rng.uniform(1.0, 1.8),
                release=float(rng.uniform(0.3, 0.6)),
                fade=float(rng.uniform(0.01, 0.03)),
                tremor=tuple(rng.uniform(0, 2 * np.pi, size=3).tolist()),
            )
            t = session.clock(hand.release + ringing)
            runs.append(
                BenchRun(
                    id=f"decay-{cart}{_LETTERS[repeat]}",
                    kind="decay",
                    t=t,
                    u=np.zeros_like(t),
                    free=(cart,),
                    hand=hand,
                )
            )
    return runs


def plan_steps(session: SimulatedSession) -> list[BenchRun]:
    """Return input steps, on and off: small ones, and larger ones in the other direction."""
    chain = session.chain
    wait = settling_wait(chain, time_constants=SETTLED)
    t = session.clock(_REST + 2 * wait)
    on = (t >= _REST) & (t < _REST + wait)
    # Carts with little damping overshoot to nearly twice their final position.
    unit = session.travel / float(np.max(np.abs(chain.static_gains())))
    small, large = _typed(0.5 * unit, session), _typed(0.9 * unit, session)
    return [
        BenchRun(
            id=f"step-{number}",
            kind="step",
            t=t,
            u=np.where(on, u, 0.0),
            free=_all(session),
            note=f"{u:g} on, then off",
        )
        for number, u in enumerate([small, -large] * session.repeats, start=1)
    ]


def plan_dwells(session: SimulatedSession) -> list[BenchRun]:
    """Return a dwell at each frequency, with an input that moves the carts far enough."""
    chain, runs = session.chain, []
    frequencies = dwell_frequencies(chain, n=session.n_dwells, among=[FIGURE_FREQUENCY])
    for number, hertz in enumerate(frequencies, start=1):
        # A compact session records one dwell in ten from rest.
        whole = session.transients or hertz == FIGURE_FREQUENCY or number % 10 == 0
        settled = SETTLED_DWELL if whole else 11.0  # time constants; then no transient is left
        wait = settling_wait(chain, time_constants=settled)
        t = session.clock(wait + steady_time(hertz))
        shape = np.sin(2 * np.pi * hertz * t)
        unit = largest_motion(chain, t, shape=shape, wait=wait)
        # Far above the resonances, the carts swing far at first, then hardly move.
        amplitude = _typed(session.travel * min(0.8 / unit.steady, 1.5 / unit.furthest), session)
        runs.append(
            BenchRun(
                id=f"sine-{number:02d}",
                kind="sine",
                t=t,
                u=np.round(amplitude * shape, INPUT_DECIMALS),
                free=_all(session),
                frequency=hertz,
                keep_from=0.0 if whole else wait,
                note="" if whole else "recorded after the transient",
            )
        )
    return runs


def plan_sweep(session: SimulatedSession) -> BenchRun:
    """Return a sweep from below the first resonance to above the last, and 2 s of ringing."""
    chain = session.chain
    omega = quadratic_factors(chain.poles)[0]
    low, high = 0.4 * omega[0], 1.4 * omega[-1]
    t = session.clock(session.sweep_time + 2.0)
    growth = np.log(high / low) / session.sweep_time
    phase = low / growth * np.expm1(growth * np.minimum(t, session.sweep_time))
    shape = np.sin(phase) * (t < session.sweep_time)
    furthest = float(np.max(np.abs(simulate_linear(chain, t, shape))))
    u = np.round(_typed(1.2 * session.travel / furthest, session) * shape, INPUT_DECIMALS)
    return BenchRun(
        id="sweep",
        kind="sweep",
        t=t,
        u=u,
        free=_all(session),
        note=f"chirp, {low / (2 * np.pi):.1f} Hz to {high / (2 * np.pi):.1f} Hz",
    )


def plan_closed_loop(
    session: SimulatedSession, *, cart: int, controller: StateFeedback
) -> BenchRun:
    """Return a run in which the set point of one cart steps under state feedback."""
    t = session.clock(_REST + 4.0)
    return BenchRun(
        id="control",
        kind="closed_loop",
        t=t,
        u=np.zeros_like(t),
        free=_all(session),
        cart=cart,
        reference=np.where(t >= _REST, session.travel, 0.0),
        controller=controller,
        input_limit=session.bench.input_limit,
    )


def _all(session: SimulatedSession) -> tuple[int, ...]:
    return tuple(range(1, session.chain.n + 1))


def _typed(value: float, session: SimulatedSession) -> float:
    """Return the input as people type it: two digits, within the limit."""
    return min(float(f"{value:.2g}"), session.bench.input_limit)
