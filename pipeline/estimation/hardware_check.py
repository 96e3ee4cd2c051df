"""Compare the identified chain with a run it was not fitted to: Figures 15-17.

There are two simulations of each cart. In "closed", the controller that ran on the hardware closes
the loop around the chain, with its delay and saturation. In "open", the measured input drives the
chain. This also tests the logged input, whose sign and scale some benches change in closed loop.
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline import submission
from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.noise import local_noise
from pipeline.plant import sampled_loop, simulate
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import Controller, LoopRun, Pid, StateFeedback
from pipeline.plant.simulate import simulate_linear
from pipeline.results import HardwareCheck, Record

# ------------------------------------------------ a record, prepared for comparison with a chain

_STILL = 0.02  # share of a signal's range by which it may vary and count as constant


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredRun:
    """One record and how it began; rows are the free carts, ascending.

    Attributes
    ----------
    y : readings (f, n); zero if a free cart was not measured.
    seen : whether each cart was measured (f,).
    noise : standard deviation (f,) of the readings from sample to sample, at least that of
        rounding.
    quiet : number of samples before input or reference first change, at least one.
    rest : readings at rest (f,).
    x0 : state (2f,) at the start, relative to the rest.
    """

    record: Record
    chain: Chain
    free: tuple[int, ...]
    y: Array
    seen: NDArray[np.bool_]
    noise: Array
    quiet: int
    rest: Array
    x0: Array

    @property
    def driven(self) -> bool:
        """Whether a logged input moves the carts.

        The last sample of the input acts only after the record, so it does not count.
        """
        return bool(np.any(self.record.input[:-1] != 0))

    def forced(self) -> Array:
        """Return the response (f, n) of the chain, from rest, to the logged input."""
        record = self.record
        if record.u is None:
            raise DataError(f"{record.id}: the hardware check needs a logged input, found none")
        return self._simulated(record.u, x0=np.zeros(2 * len(self.free)))

    def unforced(self) -> Array:
        """Return the readings (f, n) that the start alone causes."""
        return self.rest[:, None] + self._ringing(self.x0)

    @property
    def noise_floor(self) -> float:
        """The misfit of a simulation whose only error is the noise."""
        return self.misfit(self.y + self.noise[:, None])

    def input_scale(self) -> float:
        """Return the factor on the logged input that explains the motion best."""
        forced = self.forced()[self.seen]
        moved = (self.y - self.unforced())[self.seen]
        return float(np.sum(moved * forced) / np.sum(forced**2))

    def best_misfit(self) -> float:
        """Return the misfit of the open loop if its input is multiplied by the best factor."""
        return self.misfit(self.unforced() + self.input_scale() * self.forced())

    def misfit(self, model: Array) -> float:
        """Return the pooled NRMSE of readings `model` (f, n) over the measured carts."""
        error, motion = self.y - model, self.y - self.rest[:, None]
        return float(np.sqrt(np.sum(error[self.seen] ** 2) / np.sum(motion[self.seen] ** 2)))

    def begun_in_motion(self) -> "MeasuredRun":
        """Return the run with its rest and initial state fitted to the whole record.

        This is a linear least-squares fit. It includes a free factor on the input, so that a wrong
        scale of the input does not affect the start.
        """
        n = self.record.t.size
        states = np.eye(2 * len(self.free))
        forced = self.forced() if self.driven else np.zeros_like(self.y)
        columns = [forced, *(self._ringing(state) for state in states)]
        columns += [np.outer(cart, np.ones(n)) for cart in np.eye(len(self.free))]
        rows = np.array([column[self.seen].ravel() for column in columns])
        size = np.linalg.norm(rows, axis=1)
        known = size > 0  # the rest of an unmeasured cart cannot be fitted
        fitted = np.zeros(len(columns))
        target = self.y[self.seen].ravel()
        fitted[known] = np.linalg.lstsq((rows[known] / size[known, None]).T, target)[0]
        fitted[known] /= size[known]
        return replace(self, x0=fitted[1 : 1 + len(states)], rest=fitted[1 + len(states) :])

    def step_window(self, signal: Array | None) -> slice | None:
        """Return the samples from the first step of `signal` (n,) to its next step or its end.

        The result is None if there is no step, or if too few samples follow it.
        """
        if signal is None or not np.any(signal):
            return None
        # Before the record the signal was zero, so a signal that is on at the first sample steps
        # there. A step is a change by 30 % of the range within one sample.
        edges = np.flatnonzero(np.abs(np.diff(signal, prepend=0.0)) > 0.3 * np.ptp([0.0, *signal]))
        if edges.size == 0:
            return None
        stop = int(edges[1]) if edges.size > 1 else signal.size
        window = slice(int(edges[0]), stop)
        return window if window.stop - window.start >= 10 else None

    def _ringing(self, x0: Array) -> Array:
        t = self.record.t
        if not np.any(x0):
            return np.zeros((len(self.free), t.size))
        return self._simulated(np.zeros(t.size), x0=x0)

    def _simulated(self, u: Array, *, x0: Array) -> Array:
        """Return the chain's positions (f, n) under an input u (n,).

        Raises
        ------
        DataError : the positions overflow, because the chain fits nothing.
        """
        record = self.record
        with np.errstate(over="ignore", invalid="ignore"):
            y = simulate_linear(self.chain, record.t, u, x0=x0, free=self.free, hold=record.hold)
        if not np.all(np.isfinite(y)):
            raise DataError(
                f"{record.id}: the identified carts cannot be simulated over this recording"
            )
        return y


def measured_run(record: Record, chain: Chain) -> MeasuredRun:
    """Return the run. Its rest is read at the start, or fitted if the run begins in motion.

    Raises
    ------
    DataError : cart 1 was held, or no free cart was measured or moved.
    """
    if 1 not in record.free:
        raise DataError(
            f"{record.id}: the hardware check needs cart 1, which the motor drives, to be free, "
            f"found free {sorted(set(record.free))}"
        )
    run = _begin(record, chain)
    # A range of more than six standard deviations is not due to chance.
    at_rest = np.all(np.ptp(run.y[:, : run.quiet], axis=1) <= 6 * run.noise)
    # At least five samples are needed to determine a rest.
    if not run.driven or (at_rest and run.quiet >= 5):
        return run
    moving = run.begun_in_motion()
    usual = at_rest and record.kind in ("step", "closed_loop")
    # A start in motion is accepted only if it halves the misfit of a start from rest.
    return run if usual and moving.best_misfit() > 0.5 * run.best_misfit() else moving


def released_run(record: Record, chain: Chain) -> MeasuredRun:
    """Return a run in free motion from its first sample, with rest and start fitted to all of it.

    Raises
    ------
    DataError : no free cart was measured or moved.
    """
    return _begin(record, chain).begun_in_motion()


def _begin(record: Record, chain: Chain) -> MeasuredRun:
    """Return the run under the assumption that it began at rest."""
    t, free = record.t, tuple(sorted(set(record.free)))
    seen = np.array([cart in record.carts for cart in free])
    y = np.array([record.position(c) if c in record.carts else np.zeros(t.size) for c in free])
    if not np.any(np.ptp(y, axis=1) > 0):
        raise DataError(f"{record.id}: the hardware check needs a cart that moves, found none")
    quiet = _quiet_samples(record)
    noise = [local_noise(t, y[i]) if s else 0.0 for i, s in enumerate(seen)]
    step = [record.encoder_step(c) if c in record.carts else 0.0 for c in free]
    return MeasuredRun(
        record=record,
        chain=chain,
        free=free,
        y=y,
        seen=seen,
        noise=np.maximum(noise, step),
        quiet=quiet,
        rest=y[:, :quiet].mean(axis=1),
        x0=np.zeros(2 * len(free)),
    )


def _quiet_samples(record: Record) -> int:
    quiet = record.t.size
    for signal in (record.u, record.reference):
        if signal is not None:
            changes = np.abs(signal - signal[0]) > _STILL * np.ptp(signal)
            quiet = min(quiet, int(np.argmax(changes)) if changes.any() else quiet)
            if abs(signal[0]) > _STILL * np.max(np.abs(signal)):
                quiet = 1  # the input acts from the first sample
    return max(quiet, 1)


# ---------------------------------------------------------------------- the stage

# A factor on the input of up to 1.5 is an error of the model, not of the log. Another sign or scale
# is accepted if two conditions hold: the difference falls to 0.6 or less of what it was, and to at
# most 0.7 of the motion.
_TRUSTED, _WORTH_IT, _HALF = 1.5, 0.6, 0.7
_WRONG = 0.1  # share of the motion; with a larger error, the model does not belong to the run
_SERVO_PERIOD = 0.000884  # of the ECP controller, s; its log keeps one sample in several
_SETTLED_SHARE = 0.2  # share of the time after a step; the steady state is the mean of this end


def check_hardware(
    record: Record,
    chain: Chain,
    *,
    controller: submission.Controller | None = None,
    controlled_cart: int | None = None,
    input_limit: float | None = None,
) -> tuple[HardwareCheck, ...]:
    """Compare the chain with one run, cart by cart: the closed loop first, then the open loop.

    Any run with a logged input can be used. `controller` is what ran on the hardware. Without a
    controller, or without its gains, the loop is not closed.

    Parameters
    ----------
    controlled_cart : the cart whose position a PID controller fed back, unless the controller
        states it.
    input_limit : limit of the input. A lower limit found in the log has priority.

    Raises
    ------
    DataError : there is neither a logged input nor a controller with its reference and a stable
        loop; cart 1 was held; no free cart was measured, or no free cart moved.
    """
    run = measured_run(record, chain)
    opened = _open(run) if run.driven else None
    law = _plant_law(controller, controlled_cart, position_scale=record.position_scale)
    closed, trouble = None, controller.missing_gains if controller else ""
    if law is not None and record.reference is not None:
        try:
            closed = _close(run, law, reference=record.reference, opened=opened, limit=input_limit)
        except DataError as error:
            trouble = f"the loop is not simulated: {error}"
    if opened is None and closed is None:
        found = trouble or "found neither a logged input nor a controller with its reference"
        raise DataError(
            f"{record.id}: the hardware check needs a loop or an input to simulate: {found}"
        )
    steered = _steered_cart(controller, controlled_cart)
    checks: list[HardwareCheck] = []
    if closed is not None:
        closed = replace(closed, scale=opened.scale if opened else None)
        wrong = opened and _not_as_stated(run, closed, opened)
        if wrong := wrong or _another_cart(run, controller, controlled_cart):
            closed = replace(closed, note=wrong, contradicted=True)
        checks += _compare(run, closed, loop="closed", steered=steered)
    if opened is not None:
        note = "; ".join(filter(None, (trouble, opened.note)))
        checks += _compare(run, replace(opened, note=note), loop="open", steered=steered)
    return tuple(checks)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Simulated:
    """Simulated readings (f, n) of the free carts.

    `factor` is the factor used on the input, `scale` the best factor. `u` (n,) is the input of a
    simulated loop.
    """

    y: Array
    u: Array | None = None
    note: str
    contradicted: bool = False
    factor: float = 1.0
    scale: float | None = None


# -------------------------------------------------------------------- open loop


def _open(run: MeasuredRun) -> _Simulated:
    """Drive the chain with the logged input, times a factor if the log cannot be right."""
    forced, unforced, scale = run.forced(), run.unforced(), run.input_scale()
    as_logged, scaled = run.misfit(unforced + forced), run.misfit(unforced + scale * forced)
    if _plausible(scale) or scaled > min(_WORTH_IT * as_logged, _HALF):
        return _Simulated(y=unforced + forced, scale=scale, note="")
    note = (
        f"the logged input explains the motion only if multiplied by {scale:.3g}, as done here: "
        f"the difference over all carts falls from {100 * as_logged:.0f} % to {100 * scaled:.0f} % "
        "(the unit or sign of this recording's input or positions is not the stated one)"
    )
    return _Simulated(
        y=unforced + scale * forced,
        factor=scale,
        scale=scale,
        note=note,
        contradicted=scaled <= _WRONG and not _plausible(abs(scale)),
    )


def _plausible(factor: float) -> bool:
    return 1 / _TRUSTED <= factor <= _TRUSTED


# ------------------------------------------------------------------ closed loop


def _plant_law(
    controller: submission.Controller | None, cart: int | None, *, position_scale: float
) -> Controller | None:
    """Return the controller for the simulation; None if there is nothing to simulate.

    A PID controller acts on the error in the file's own counts, which `position_scale` converted to
    positions.
    """
    if controller is None or controller.missing_gains:
        return None
    if isinstance(controller, submission.PidController):
        return Pid(
            kp=controller.kp,
            ki=controller.ki,
            kd=controller.kd,
            scale=controller.scale / position_scale,
            cart=_steered_cart(controller, cart) or 1,
        )
    return StateFeedback(gains=np.array(controller.gains), prefilter=controller.prefilter)


def _steered_cart(controller: submission.Controller | None, stated: int | None) -> int | None:
    """Return the cart that the loop brings to the set point; None if it is unknown."""
    if isinstance(controller, submission.PidController) and (
        stated is None or "cart" in controller.model_fields_set
    ):
        return controller.cart
    return stated


def _close(
    run: MeasuredRun,
    law: Controller,
    *,
    reference: Array,
    opened: _Simulated | None,
    limit: float | None,
) -> _Simulated:
    """Close the loop around the chain.

    The logged input may be a multiple of what the stated law gives. If the law times this factor
    explains the run far better, the multiple is used, otherwise the law as stated.

    Raises
    ------
    DataError : the controller does not fit the free carts, or makes the loop unstable.
    """
    drive = opened.factor if opened else 1.0
    limit = min(np.inf if limit is None else limit, _plateau(run.record.u))
    loop, misfit = _run_loop(run, law, reference=reference, drive=drive, limit=limit)
    to_beat, note, times_stated = _WORTH_IT * misfit, "", 1.0
    for factor in _logged_per_stated(run, law, reference=reference, opened=opened):
        if misfit <= run.noise_floor:
            break
        times = _times(law, factor)
        scaled, less = _run_loop(run, times, reference=reference, drive=drive, limit=limit)
        if less < min(to_beat, misfit):
            loop, misfit, times_stated = scaled, less, factor
            note = f"is {factor:.3g} times" if factor != -1.0 else "has the opposite sign of"
            note = f"the logged input {note} what the stated controller asks for"
    if loop is None:
        raise DataError("the stated controller makes it unstable")
    # If only the sign differs, the controller is not wrong: under feedback, a bench may log the
    # input with the opposite sign.
    wrong = abs(times_stated) != 1.0 and misfit <= _WRONG
    return _Simulated(y=loop.x, u=loop.u, note=note, contradicted=wrong)


def _run_loop(
    run: MeasuredRun, law: Controller, *, reference: Array, drive: float, limit: float
) -> tuple[LoopRun | None, float]:
    """Return the simulated run and its misfit; the run is None if it is unstable.

    The controller's sample time, delay and prediction are not logged. So the usual combinations are
    tried, and the one nearest to the measurement is returned.
    """
    joined = sampled_loop.LoopSetup(input_limit=limit, drive=drive, rest=run.rest, free=run.free)
    best, least = None, 10.0  # times the measured motion; above this, the loop is unstable
    for law_as_run, sample_time, delay in _controller_variants(run, law, drive=drive):
        with np.errstate(over="ignore", invalid="ignore"):
            how = replace(joined, sample_time=sample_time, delay=delay)
            loop = sampled_loop.simulate_loop(
                run.chain, law_as_run, t=run.record.t, reference=reference, setup=how, start=run.x0
            )
            misfit = run.misfit(loop.x)
        if misfit < least:
            best, least = loop, misfit
        if least <= run.noise_floor:
            break
    return best, least


def _controller_variants(
    run: MeasuredRun, law: Controller, *, drive: float
) -> list[tuple[Controller, float | None, int]]:
    """Return controllers to try, each with its sample time (None: as logged) and delay in ticks."""
    ways: list[tuple[Controller, float | None, int]] = [(law, None, 1), (law, None, 0)]
    if isinstance(law, StateFeedback):
        # In units of the effort, masses, dampings and stiffnesses are divided by `drive`.
        chain = run.chain
        model = Chain(m=chain.m / drive, c=chain.c / drive, k=chain.k / drive)
        ways.insert(0, (replace(law, model=model), None, 1))
    if run.record.sample_time > 3.0 * _SERVO_PERIOD:  # otherwise this hardly differs from the first
        ways.append((law, _SERVO_PERIOD, 1))
    return ways


def _logged_per_stated(
    run: MeasuredRun, law: Controller, *, reference: Array, opened: _Simulated | None
) -> list[float]:
    """Return factors other than 1 between the logged input and the input that the law gives.

    The law is evaluated twice: at the readings, and at the positions that the chain has under the
    logged input. With fast sampling, the velocity from readings is mostly noise. But an integral of
    the error needs the readings.
    """
    record = run.record
    if record.u is None or opened is None:
        return []
    factors = []
    for y in (run.y, opened.y) if run.seen.all() else (opened.y,):
        stated = sampled_loop.replay(law, t=record.t, y=y, reference=reference, free=run.free)
        factor = _median_ratio(record.u, stated)
        factor = float(np.sign(factor)) if _plausible(abs(factor)) else factor
        if factor not in (0.0, 1.0, *factors):
            factors.append(factor)
    return factors


def _median_ratio(logged: Array, stated: Array) -> float:
    """Return the factor by which the logged input is larger than the stated one.

    It minimises the sum of absolute differences, and so is a weighted median. Samples with a
    saturated input, or with a velocity that is mostly rounding, do not affect it. If the stated
    input is always zero, it is 1.
    """
    asked = np.flatnonzero(stated)
    if asked.size == 0:
        return 1.0
    ratio, weight = logged[asked] / stated[asked], np.abs(stated[asked])
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)
    return float(ratio[order[half]])


def _not_as_stated(run: MeasuredRun, closed: _Simulated, opened: _Simulated) -> str:
    """Return a note if the chain fits under the logged input but not under the controller."""
    loop, plant = run.misfit(closed.y), run.misfit(opened.y)
    # Another controller ran if the plant is accurate to 2 % under the logged input, but the loop's
    # error is a tenth of the motion and five times as large. A stable loop increases a plant's
    # error only a few times.
    if opened.factor != 1.0 or not (plant <= 0.02 and loop > max(_WRONG, 5.0 * plant)):
        return ""
    return (
        f"the carts follow the logged input to {100 * plant:.1f} %, but the loop with the stated "
        f"controller is {100 * loop:.0f} % off: its gains, its prefilter or the reference are not "
        "those that ran"
    )


def _another_cart(
    run: MeasuredRun, controller: submission.Controller | None, cart: int | None
) -> str:
    """Return a note if the cart that comes to rest at the reference is not the stated one."""
    reference = run.record.reference
    if not isinstance(controller, submission.StateFeedbackController) or reference is None:
        return ""
    window = run.step_window(reference)
    if cart is None or window is None or (target := float(reference[window.stop - 1])) == 0.0:
        return ""
    last = slice(-max(1, round(_SETTLED_SHARE * (window.stop - window.start))), None)
    off = {
        run.free[row]: abs(float((run.y[row, window][last] - run.rest[row]).mean()) / target - 1)
        for row in np.flatnonzero(run.seen).tolist()
    }
    there = [other for other, away in off.items() if away <= 0.05]  # relative to the reference
    if len(there) != 1 or off.get(cart, 0.0) < 0.2:
        return ""
    return (
        f"controlled_cart = {cart}, but cart {there[0]} comes to rest at the reference and cart "
        f"{cart} comes to rest {100 * off[cart]:.0f} % away from it"
    )


def _plateau(u: Array | None) -> float:
    """Return the largest input if more than one sample reaches it, otherwise infinity."""
    if u is None:
        return np.inf
    size = np.abs(u)
    return float(size.max()) if np.sum(size >= 0.999 * size.max()) > 1 else np.inf


def _times(law: Controller, factor: float) -> Controller:
    if isinstance(law, Pid):
        return replace(law, scale=law.scale * factor)
    return replace(law, gains=law.gains * factor, prefilter=law.prefilter * factor)


# -------------------------------------------------------------------- comparing


def _compare(
    run: MeasuredRun,
    simulated: _Simulated,
    *,
    loop: Literal["closed", "open"],
    steered: int | None,
) -> list[HardwareCheck]:
    """Return a check for each measured cart that moved; the first check has the note."""
    record, note = run.record, simulated.note
    steps = record.reference if record.kind == "closed_loop" else record.u
    window = run.step_window(steps) if record.kind in ("closed_loop", "step") else None
    followed = None if simulated.contradicted else record.reference
    checks = []
    for row in np.flatnonzero(run.seen).tolist():
        cart, measured, model = run.free[row], run.y[row], simulated.y[row]
        motion = float(np.sum((measured - run.rest[row]) ** 2))
        if motion == 0:
            continue
        step_measured = _overshoot_and_settling(
            run, measured, row=row, window=window, noise=3 * run.noise[row]
        )
        step_model = _overshoot_and_settling(run, model, row=row, window=window, noise=0.0)
        checks.append(
            HardwareCheck(
                experiment=record.id,
                cart=cart,
                loop=loop,
                nrmse=float(np.sqrt(np.sum((measured - model) ** 2) / motion)),
                overshoot_model=step_model.overshoot,
                overshoot_measured=step_measured.overshoot,
                settling_model=step_model.settling,
                settling_measured=step_measured.settling,
                steady_state_model=step_model.level,
                steady_state_measured=step_measured.level,
                input_scale=simulated.scale,
                t=record.t,
                measured=measured,
                model=model,
                note=note,
                contradicted=simulated.contradicted,
                is_scaled=simulated.factor != 1.0,
                effort=simulated.u,
                set_point=followed if cart == steered else None,
            )
        )
        note = ""
    return checks


class _Step(NamedTuple):
    """Overshoot in percent, settling time in s, and level; None for a value that does not exist."""

    overshoot: float | None = None
    settling: float | None = None
    level: float | None = None


def _overshoot_and_settling(
    run: MeasuredRun, y: Array, *, row: int, window: slice | None, noise: float
) -> _Step:
    """Return the step measures of one cart's readings `y` (n,) in the window."""
    if window is None:
        return _Step()
    t, after = run.record.t[window], y[window]
    before = y[: window.start].mean() if window.start > 0 else run.rest[row]
    level = after[-max(1, round(_SETTLED_SHARE * after.size)) :].mean()
    # A step below 5 % of the cart's largest motion has no meaningful overshoot.
    if abs(level - before) <= max(noise, 0.05 * np.max(np.abs(y - before))):
        return _Step(level=float(level))
    settling = float(simulate.settling_time(t, after, before=before, level=level, noise=noise))
    return _Step(
        overshoot=float(simulate.overshoot_percent(after, before=before, level=level)),
        settling=None if np.isnan(settling) else settling,
        level=float(level),
    )
