"""A record prepared for comparison with a chain: how it began, and where it steps."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.noise import local_noise
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import Record

_STILL = 0.02  # share of a signal's range by which it may vary and count as constant
_MIN_STEP_SAMPLES = 10


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
        return self.record.u is not None and bool(np.any(self.record.u[:-1] != 0))

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
        return window if window.stop - window.start >= _MIN_STEP_SAMPLES else None

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
            raise DataError(f"{record.id}: the identified carts cannot be simulated over this run")
        return y


def measured_run(record: Record, chain: Chain) -> MeasuredRun:
    """Return the run. Its rest is read at the start, or fitted if the run begins in motion.

    Raises
    ------
    DataError : cart 1 was held, or no free cart was measured or moved.
    """
    free = tuple(sorted(set(record.free)))
    if 1 not in free:
        raise DataError(
            f"{record.id}: the hardware check needs cart 1, which the motor drives, to be free, "
            f"found free {list(free)}"
        )
    run = _begin(record, chain, free=free)
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
    return _begin(record, chain, free=tuple(sorted(set(record.free)))).begun_in_motion()


def _begin(record: Record, chain: Chain, *, free: tuple[int, ...]) -> MeasuredRun:
    """Return the run under the assumption that it began at rest."""
    t = record.t
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
