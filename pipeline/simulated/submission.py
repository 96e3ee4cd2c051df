"""Write a plant as a whole submission: `submission.toml` and the data that a class would record."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.state_feedback import design_feedback
from pipeline.names import read_name
from pipeline.plant import simulate
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.sampled_loop import StateFeedback
from pipeline.results import FeedbackDesign
from pipeline.simulated.bench import BenchRun, ReleasingHand, SimulatedBench, TrueMotion
from pipeline.simulated.hidden import preset_bench
from pipeline.submission import Design
from pipeline.submission.toml import TypedNumber, Value, toml_section

# ------------------------------------------------------------ the runs of one laboratory session

_TIME_DECIMALS = 5
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

    def clock(self, duration: float) -> Array:
        """Return sample times (n,) from 0 to about `duration`, s."""
        return self.bench.sample_time * np.arange(
            np.ceil(duration / self.bench.sample_time) + 1, dtype=np.float64
        )


def plan_decays(session: SimulatedSession, rng: np.random.Generator) -> list[BenchRun]:
    """Return several decays of each cart, released by hand while the other carts are held.

    Carts without a spring are skipped.
    """
    chain, runs = session.bench.chain, []
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
                position=side * session.bench.travel * rng.uniform(1.0, 1.8),
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
    chain = session.bench.chain
    wait = simulate.settling_wait(chain, time_constants=simulate.SETTLED)
    t = session.clock(_REST + 2 * wait)
    on = (t >= _REST) & (t < _REST + wait)
    # Carts with little damping overshoot to nearly twice their final position.
    unit = session.bench.travel / float(np.max(np.abs(chain.static_gains())))
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
    chain, runs = session.bench.chain, []
    frequencies = simulate.dwell_frequencies(chain, n=session.n_dwells, among=[FIGURE_FREQUENCY])
    for number, hertz in enumerate(frequencies, start=1):
        # A compact session records one dwell in ten from rest.
        whole = session.transients or hertz == FIGURE_FREQUENCY or number % 10 == 0
        settled = (
            simulate.SETTLED_DWELL if whole else 11.0
        )  # time constants; then no transient is left
        wait = simulate.settling_wait(chain, time_constants=settled)
        t = session.clock(wait + simulate.steady_time(hertz))
        shape = np.sin(2 * np.pi * hertz * t)
        steady, most = simulate.largest_motion(chain, t, shape=shape, wait=wait)
        # Far above the resonances, the carts swing far at first, then hardly move.
        amplitude = _typed(session.bench.travel * min(0.8 / steady, 1.5 / most), session)
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
    chain = session.bench.chain
    omega = quadratic_factors(chain.poles)[0]
    low, high = 0.4 * omega[0], 1.4 * omega[-1]
    t = session.clock(session.sweep_time + 2.0)
    growth = np.log(high / low) / session.sweep_time
    phase = low / growth * np.expm1(growth * np.minimum(t, session.sweep_time))
    shape = np.sin(phase) * (t < session.sweep_time)
    furthest = float(np.max(np.abs(simulate.simulate_linear(chain, t, shape))))
    u = np.round(_typed(1.2 * session.bench.travel / furthest, session) * shape, INPUT_DECIMALS)
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
        reference=np.where(t >= _REST, session.bench.travel, 0.0),
        controller=controller,
        input_limit=session.bench.input_limit,
    )


def _all(session: SimulatedSession) -> tuple[int, ...]:
    return tuple(range(1, session.bench.chain.n + 1))


def _typed(value: float, session: SimulatedSession) -> float:
    """Return the input as people type it: two digits, within the limit."""
    return min(float(f"{value:.2g}"), session.bench.input_limit)


# ---------------------------------------------------------------------- the submission


@dataclass(frozen=True, kw_only=True)
class Students:
    """The people who measured a simulated bench, and what they write.

    Attributes
    ----------
    authors : ids of the authors. By default, these are two ids that depend on the seed, so that no
        two teams share one.
    title : title of the submission. By default it names the bench and the seed.
    springs : whether they declare each spring as present. By default, they state the true springs.
    is_anonymous : whether nobody is named; the students then enter themselves.
    """

    authors: Sequence[str] = ()
    title: str = ""
    springs: Sequence[bool] = ()
    is_anonymous: bool = False


def write_submission(
    folder: Path,
    bench: SimulatedBench | str,
    *,
    seed: int,
    compact: bool = False,
    reported: bool = False,
    students: Students | None = None,
) -> None:
    """Write the submission of students who measured a bench; same arguments, same bytes.

    No file mentions the bench's effects, and the students assume a linear chain.

    Parameters
    ----------
    folder : folder to write; it is made if necessary. Files of the same names are replaced.
    bench : the true plant, or the name of a preset.
    compact : whether to record less, which halves the size: fewer repeats and dwells, and most
        dwells without their transient.
    reported : whether to add `[reported]`, the numbers that honest students report.

    Raises
    ------
    ConfigError : there is no such preset, or the simulation would take too long.
    DataError : the chain never settles, has no static gain, or diverges with its effects.
    """
    bench = preset_bench(bench) if isinstance(bench, str) else bench
    bench.refuse_endless()
    students = students or Students()
    rng = np.random.default_rng(seed)
    believed = believed_chain(bench.chain, rng)
    task = _task(bench)
    design = _design(believed, task)
    programme = _programme(bench, rng, compact=compact, design=design, believed=believed)
    logs = {}
    for run in programme:
        motion = bench.move(run)
        y = bench.read(motion, run=run, rng=rng)
        logs[_data_file(run)] = _csv_text(run, motion, y, count=bench.count)
    sections = [
        *_head(bench, students, seed=seed),
        toml_section("[design]", task.model_dump()),
        *(toml_section("[[experiments]]", _experiment(run)) for run in programme),
    ]
    if reported:
        hertz = [run.frequency for run in programme if run.frequency]
        initial = initial_estimates(bench.chain, dwells_hz=hertz, rng=rng)
        sections += [
            toml_section("[reported.initial]", initial),
            toml_section("[reported.final]", final_estimates(believed)),
            toml_section("[reported.state_space]", state_space(believed)),
            toml_section("[reported.feedback]", feedback(design)),
        ]
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for file, text in logs.items():
        _write(folder / file, text)
    _write(folder / "submission.toml", "\n".join(sections))


def _task(bench: SimulatedBench) -> Design:
    return Design(
        cart=min(2, bench.chain.n),  # the far one of two carts; for three, the paper's choice
        reference=bench.travel,
        overshoot_percent=10.0,
        settling_time=1.0,
        input_limit=bench.input_limit,
        sample_time=bench.sample_time,
        method="lqr",
    )


def _programme(
    bench: SimulatedBench,
    rng: np.random.Generator,
    *,
    compact: bool,
    design: FeedbackDesign,
    believed: Chain,
) -> list[BenchRun]:
    session = SimulatedSession(
        bench=bench,
        repeats=2 if compact else 3,
        n_dwells=22 if compact else 28,
        transients=not compact,
        sweep_time=12.0 if compact else 20.0,
    )
    law = StateFeedback(gains=design.gains, prefilter=design.prefilter, model=believed)
    return [
        *plan_decays(session, rng),
        *plan_steps(session),
        *plan_dwells(session),
        plan_sweep(session),
        plan_closed_loop(session, cart=min(2, bench.chain.n), controller=law),
    ]


def _head(bench: SimulatedBench, students: Students, *, seed: int) -> Iterator[str]:
    """Yield the tables that come before the experiments."""
    named = f"Simulated bench, {bench.name}, seed {seed}" if bench.name else "Simulated bench"
    title = students.title or named
    yield toml_section("", {"version": 1, "title": title, "section": "01"})
    nobody = () if students.is_anonymous else (f"s{1001 + 2 * seed}", f"s{1002 + 2 * seed}")
    for author in students.authors or nobody:
        yield toml_section("[[authors]]", {"id": author})
    system: dict[str, Value] = {
        "carts": bench.chain.n,
        "springs": list(students.springs) or [bool(k > 0) for k in bench.chain.k],
        "input": {"unit": bench.input_unit, "sign": 1},
        "position": {"unit": bench.position_unit},
    }
    yield toml_section("[system]", system)


def _design(believed: Chain, task: Design) -> FeedbackDesign:
    """Return the controller as it is typed into the bench: gains with four digits."""
    design = design_feedback(believed, task)
    return replace(
        design,
        gains=np.array([float(f"{gain:.4g}") for gain in design.gains]),
        prefilter=float(f"{design.prefilter:.4g}"),
    )


def _csv_text(run: BenchRun, motion: TrueMotion, y: Array, *, count: float) -> str:
    """Return the log of one run: time, input, reference (in a closed loop), and x1 … xn.

    `y` (n_carts, n) holds whole counts in position units. They are written with one digit more than
    is needed to distinguish counts.
    """
    kept = run.t >= run.keep_from
    columns = {"time": _fixed(run.t[kept] - run.t[kept][0], _TIME_DECIMALS)}
    columns["input"] = _fixed(motion.u[kept], INPUT_DECIMALS)
    if run.reference is not None:
        columns["reference"] = _fixed(run.reference[kept], INPUT_DECIMALS)
    position_decimals = max(0, math.ceil(-math.log10(count)) + 1)
    for cart, positions in enumerate(y, start=1):
        columns[f"x{cart}"] = _fixed(positions[kept], position_decimals)
    rows = zip(*columns.values(), strict=True)
    return "\n".join(",".join(row) for row in [tuple(columns), *rows]) + "\n"


def _fixed(values: Array, decimals: int) -> list[str]:
    """Return numbers with fixed decimals, without trailing zeros and without -0."""
    texts = [f"{value:.{decimals}f}" for value in np.round(values, decimals) + 0.0]
    return [text.rstrip("0").rstrip(".") for text in texts] if decimals else texts


def _data_file(run: BenchRun) -> str:
    return f"data/{run.id}.csv"


def _experiment(run: BenchRun) -> dict[str, Value]:
    """Return the keys of one `[[experiments]]` table."""
    entry: dict[str, Value] = {"id": run.id, "kind": run.kind}
    if run.kind == "decay":
        entry["carts"] = list(run.free)
    if run.frequency is not None:
        entry["frequency"] = run.frequency
    if run.controller is not None and run.cart is not None:
        entry["controlled_cart"] = run.cart
        entry["controller"] = {
            "type": "state_feedback",
            "gains": run.controller.gains.tolist(),
            "prefilter": run.controller.prefilter,
        }
    entry["file"] = _data_file(run)
    if run.note:
        entry["note"] = run.note
    return entry


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


# Typical errors of a fit to some twenty dwells, as relative standard deviations.
_FIT_ERROR_SPRING_OR_MASS = 0.005
# Typical error of initial estimates that are read from plots of steps and decays.
_HAND_ERROR = 0.007
# the paper: "we usually use the initial estimate that both are approximately 0.1"
_GUESSED_ZETA = TypedNumber("0.10")


def believed_chain(chain: Chain, rng: np.random.Generator) -> Chain:
    """Return the chain that the students have identified."""

    def off(values: np.ndarray, spread: float) -> np.ndarray:
        return values * (1 + spread * np.clip(rng.standard_normal(values.size), -2, 2))

    return Chain(
        m=off(chain.m, _FIT_ERROR_SPRING_OR_MASS),
        c=off(chain.c, 0.04),
        k=off(chain.k, _FIT_ERROR_SPRING_OR_MASS),
    )


def initial_estimates(
    chain: Chain, *, dwells_hz: Sequence[float], rng: np.random.Generator
) -> dict[str, Value]:
    """Return the students' initial estimates of every named parameter.

    Gains come from the steps. The carts' own frequencies and dampings come from their decays.
    Resonances and nulls are at the nearest dwell, and their dampings are guessed; without dwells,
    all numbers are read with similar errors.
    """
    typed: dict[str, Value] = {}
    for name, value in chain.parameters().items():
        read = read_name(name)
        error = float(np.clip(rng.standard_normal(), -2, 2))
        if read.is_by_eye and chain.n > 1 and dwells_hz:
            nearest = min((2 * math.pi * f for f in dwells_hz), key=lambda w: abs(w - value))
            typed[name] = _GUESSED_ZETA if read.is_ratio else _significant(nearest)
        else:
            spread = 0.08 if read.is_ratio else _HAND_ERROR
            typed[name] = _significant(value * (1 + spread * error))
    return typed


def final_estimates(believed: Chain) -> dict[str, Value]:
    """Return the students' fitted parameters, consistent because they come from one chain."""
    return {name: _significant(value) for name, value in believed.parameters().items()}


def state_space(believed: Chain) -> dict[str, Value]:
    """Return A (2n, 2n) and B (2n,) as the students report them."""
    A, B, _, _ = believed.state_space()
    return {
        "A": [[_significant(a, 4) for a in row] for row in A],
        "B": [_significant(b, 4) for b in B[:, 0]],
    }


def feedback(design: FeedbackDesign) -> dict[str, Value]:
    """Return the controller and its simulated results as the students report them."""
    typed: dict[str, Value] = {
        "gains": [_significant(gain, 4) for gain in design.gains],
        "prefilter": _significant(design.prefilter, 4),
        "overshoot_percent": TypedNumber(f"{design.overshoot_percent:.1f}"),
    }
    if design.settling_time is not None:
        typed["settling_time"] = TypedNumber(f"{design.settling_time:.2f}")
    return typed


def _significant(value: float, digits: int = 3) -> TypedNumber:
    """Return the number rounded to significant digits, with trailing zeros."""
    exact = value in (0.0, 1.0)  # entries of a state matrix that are exact
    return TypedNumber(f"{value:g}" if exact else f"{value:#.{digits}g}".removesuffix("."))
