"""Find the free decay in a record, and fit it from the release to its last turning point."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.decay.laws import Explained, explain_decay
from pipeline.estimation.decay.ringing import Ringing, fit_ringing
from pipeline.estimation.noise import MEDIAN_TO_SIGMA
from pipeline.estimation.peaks import extrema, plateaus
from pipeline.results import Record

# Ratio of residual to noise below which a model is complete. With 50 samples, chance changes the
# ratio by a tenth.
_ADEQUATE = 1.5
# Smallest swing to count, in grains. A grain is the encoder step, or the step whose rounding error
# equals the noise if this is larger.
_PROMINENCE = 6.0
_SMALLEST_SWING = 8.0
_BASE_SKIPS, _BASE_NEEDS = 2, 4  # turning points skipped for the hand, and needed after them
_MIN_SAMPLES = 12
# Extended back in time, a fit may miss the record by this many of its own residuals. A share of the
# amplitude is added while only the smaller swings were fitted, or if the residual exceeds the noise
# anyway.
_BACK_SIGMAS = 4.0
_BACK_SHARES = (0.05, 0.0, 0.0, 0.0)
_REAL_SHARE = 0.15
_RELEASE_MARGIN = 1 / 40  # share of a period, in which the fingers leave the cart


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """Samples [first, stop) of a record; `level` is their constant input.

    It is None for a whole record, whose input may vary or be missing.
    """

    first: int
    stop: int
    level: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeDecay:
    """Samples [first, stop) of one free decay, its turning points, and the fits to it.

    `fit` is the exponential fit, and `explained` the test of it, None if it was not tested.
    """

    stretch: Stretch
    first: int
    stop: int
    turning: list[int]
    fit: Ringing
    explained: Explained | None

    @property
    def model(self) -> Callable[[Array], Array]:
        """The law that the decay follows, as a function of time, or the exponential fit."""
        law = self.explained.law if self.explained else None
        return law.model if law else self.fit

    def residual(self, t: Array, y: Array) -> Array:
        """Return what the model leaves of the decay; `t` and `y` cover the record."""
        window = slice(self.first, self.stop)
        return y[window] - self.model(t[window])

    def rms(self, t: Array, y: Array) -> float:
        """Return the root-mean-square residual over the decay; `t` and `y` cover the record."""
        return float(np.sqrt(np.mean(self.residual(t, y) ** 2)))


def find_decay(record: Record, *, cart: int, size: float) -> tuple[Stretch, list[int]]:
    """Return the turning points of the record's largest free decay, and the stretch around it.

    `size` is the smallest significant change. Stretches without input are preferred.

    Raises
    ------
    DataError : no stretch has two turning points of one decay.
    """
    y = record.position(cart)
    most = 0
    for group in _stretches(record):
        found = [(stretch, _decaying_run(record.t, y, stretch, size=size)) for stretch in group]
        stretch, run = max(found, key=lambda pair: _score(y, pair[1]), default=(None, []))
        most = max(most, len(run))
        if stretch and len(run) >= 2:
            return stretch, run
    raise DataError(
        f"{record.id}: log decrement needs 3 turning points of a free decay of cart {cart} (the "
        f"release and two more) with swings over {_SMALLEST_SWING:.0f} encoder steps, found "
        f"{most}"
    )


def _stretches(record: Record) -> list[list[Stretch]]:
    """Return groups of stretches to search, in order: with zero input, and with constant input.

    For a decay, or without an input, the whole record comes last.
    """
    whole = Stretch(first=0, stop=record.t.size, level=None)
    if record.u is None:
        return [[whole]]
    u = record.u
    parts = [
        Stretch(first=a, stop=b, level=float(np.mean(u[a:b])))
        for a, b in plateaus(u)
        if b - a >= _MIN_SAMPLES
    ]
    largest = float(np.max(np.abs(u)))
    # Below 2 % of the largest input, the input counts as zero.
    off = [part for part in parts if abs(part.level or 0.0) <= 0.02 * largest]
    on = [part for part in parts if part not in off]
    return [off, on, [whole]] if record.kind == "decay" else [off, on]


def _decaying_run(t: Array, y: Array, stretch: Stretch, *, size: float) -> list[int]:
    """Return the turning points of the largest run of decreasing swings at regular times."""
    part = y[stretch.first : stretch.stop]
    # The first point is the start of the stretch, not a turning point. The last one is where the
    # cart came to rest; it counts if the cart came to rest in time.
    turning = [i + stretch.first for i in extrema(part, prominence=_PROMINENCE * size)][1:]
    swings = np.abs(np.diff(y[turning]))
    times = np.diff(t[turning])
    best: list[int] = []
    start = 0
    while start < swings.size:
        end = start + 1
        # A swing may exceed the one before by 2 %. Each interval must be within 30 % of the median
        # of the earlier intervals, because motion by hand is less regular.
        while (
            end < swings.size
            and _SMALLEST_SWING * size <= swings[end] <= 1.02 * swings[end - 1]
            and abs(times[end] / np.median(times[start:end]) - 1) <= 0.3
        ):
            end += 1
        best = max(best, turning[start : end + 1], key=lambda run: _score(y, run))
        start = end
    return best


def _score(y: Array, run: list[int]) -> float:
    """Rank a run: first by whether it has several swings, then by size."""
    if len(run) < 2:
        return 0.0
    travelled = float(np.sum(np.abs(np.diff(y[run]))))
    return travelled if len(run) > 2 else 1e-3 * travelled


def fit_decay(
    t: Array, y: Array, *, stretch: Stretch, run: list[int], floor: float, step: float
) -> FreeDecay:
    """Fit the free decay from its release to its last turning point.

    The later swings are fitted first. The fit is then extended back over the earlier ones as long
    as they agree. This finds where the hand lets go. If not even the later swings fit down to the
    noise (real friction is not ideal), all swings are used.

    Parameters
    ----------
    run : the turning points.
    floor : the smallest significant residual (root mean square).
    step : the encoder step.
    """
    interval = float(np.median(np.diff(t[run])))
    stop = run[-1] + 1
    # With fewer turning points, the fit also needs the rest that follows them.
    if len(run) < 5:
        stop = int(np.searchsorted(t[: stretch.stop], t[run[-1]] + 2 * interval))
    pole = complex(-np.log(_ratio(y, run)) / interval, np.pi / interval)

    def fit_from(
        first: int, *, after: FreeDecay | None = None, last: bool = False, rough: bool = False
    ) -> FreeDecay:
        """Fit on from the fit `after`, whose law is kept until all compete again in the `last` fit.

        The exponential is tested only if its residual exceeds the noise, unless it is `rough`.
        """
        near = complex(after.fit.poles[0]) if after else pole
        known = after.explained.law if after and after.explained and not last else None
        own = slice(first, stop)
        fit = fit_ringing(t[own], y[own], poles=np.array([near]), drift=True)
        explained = None
        # A fit that does not turn within the record follows noise.
        turns = fit.poles[0].imag * float(t[own][-1] - t[own][0]) > np.pi
        if turns and (last or (not rough and fit.rms > _ADEQUATE * floor)):
            explained = explain_decay(
                t[own],
                y[own],
                fit,
                step=step,
                floor=floor,
                turning=t[run],
                falling=bool(y[run[1]] < y[run[0]]),
                only=known.name if known else None,
            )
        turning = [i for i in run if i > first]
        return FreeDecay(
            stretch=stretch, first=first, stop=stop, turning=turning, fit=fit, explained=explained
        )

    enough = max(stop - _MIN_SAMPLES, stretch.first)
    latest = min(run[min(_BASE_SKIPS, max(len(run) - _BASE_NEEDS, 0))], enough)
    decay = fit_from(latest)
    if decay.rms(t, y) > _ADEQUATE * floor:
        # The model does not cover the start of a real cart's motion, so the fit begins at the first
        # passage through rest.
        decay = fit_from(min(run[0], enough))
        passage = int(np.searchsorted(t, t[run[0]] - interval / 2))
        held = _carried_back(t, y, decay, latest=decay.first, share=_REAL_SHARE, floor=floor)
        return fit_from(passage if held <= passage < decay.first else decay.first, last=True)
    for share in _BACK_SHARES:
        first = _carried_back(t, y, decay, latest=latest, share=share, floor=floor)
        if first == decay.first:
            break
        rough = share > 0 and decay.explained is None
        decay = fit_from(first, after=decay, rough=rough)
    first = decay.first
    if first > stretch.first:
        margin = t[first] + _RELEASE_MARGIN * 2 * interval
        first = min(int(np.searchsorted(t, margin)), latest)
    return fit_from(first, after=decay, last=True)


def _carried_back(
    t: Array, y: Array, decay: FreeDecay, *, latest: int, share: float, floor: float
) -> int:
    """Return the first sample from which the decay's model holds, at most `latest`."""
    head = slice(decay.stretch.first, latest)
    size = abs(decay.fit.amplitudes[0]) * decay.fit.growth(t[head])[0]
    # The median ignores a hold that the fit includes by mistake.
    spread = MEDIAN_TO_SIGMA * float(np.median(np.abs(decay.residual(t, y))))
    tolerance = _BACK_SIGMAS * max(spread, floor) + share * size
    bad = np.flatnonzero(np.abs(y[head] - decay.model(t[head])) > tolerance)
    return head.start + (int(bad[-1]) + 1 if bad.size else 0)


def _ratio(y: Array, run: list[int]) -> float:
    """Return the mean ratio of each swing to the one before, or a guess if there is only one."""
    swings = np.abs(np.diff(y[run]))
    return float((swings[-1] / swings[0]) ** (1 / (swings.size - 1))) if swings.size > 1 else 0.3
