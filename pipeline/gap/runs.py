"""Prepare records for fitting: cut to free motion, hold some out, count independent readings."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.force_balance import between
from pipeline.estimation.noise import difference_noise, extrema
from pipeline.gap.pem.kernel import PemRunArrays
from pipeline.plant.simulate import interpolate_band_limited
from pipeline.plant.simulator.kernel import Excitation, describe_run
from pipeline.results import Finding, Intervention, Record
from pipeline.words.numbers import group_messages
from pipeline.words.phrases import phrases

# --------------------------------------- one record: where it moves freely, its start, its noise

_STILL = 2.6  # encoder steps, peak to peak; a smaller range counts as rest
_SMOOTHING = 0.03  # s, half width of a local cubic for a bench of carts
# A hand holds a cart at the top of its motion if the cart stays there for this many samples, and
# `_HELD_TIME` times as long as in free motion.
_HELD_SAMPLES = 4
_HELD_TIME = 2.0
_HELD_STILL = 0.1  # s; carts that an input moves at once do not rest this long
_RESTING = 1.5  # encoder steps; largest range of readings of a cart at rest
_ONE_READING = 0.07  # s; at rest, this time counts as one independent reading
_LONGEST = 2.5e-3  # s; longest step of the prediction-error fit for a bench of carts


@dataclass(frozen=True, kw_only=True, eq=False)
class GapRun:
    """One record in the form that the fits use.

    Attributes
    ----------
    t : times (samples,) from the first sample used, s.
    y : readings (rows, samples).
    rows : cart index (from 0) of each row. Held carts have no row.
    free : whether each cart moves (n,).
    guided : motion (n, samples) of held carts that still move; zero for all other carts.
    knots, command : times and values of the input, held from knot to knot. They begin before the
        first sample, because a delay or a lag remembers the earlier input.
    at_rest : whether the carts are at rest at the first sample.
    start_known : whether the start is taken from the first readings, as on a bench without springs.
        Otherwise it is fitted.
    rest : rest positions (n,), as readings.
    zero, zero_std : expected encoder zeros (n,) and their uncertainty; see `with_zeros`.
    sigma : noise (rows,) of one sample.
    weight : factor (rows, samples), at most 1, on each sample's residual.
    block : number of samples that `thin` averages to one residual.
    pace : 1 for a bench of carts, and smaller in proportion for faster systems.
    shots : bounds (shots + 1,) of pieces that have their own start. (0, samples) is the whole run.
    shot_x, shot_v : smoothed positions (with encoder zeros) and velocities (shots, n) at the start
        of each shot.
    """

    id: str
    record: Record
    t: Array
    y: Array
    rows: tuple[int, ...]
    free: tuple[bool, ...]
    guided: Array
    knots: Array
    command: Array
    at_rest: bool
    rest: Array
    zero: Array
    zero_std: Array
    sigma: Array
    weight: Array
    block: int
    pace: float
    shots: tuple[int, ...]
    shot_x: Array
    shot_v: Array
    start_known: bool = False

    @property
    def start(self) -> Array:
        """The first reading (n,) of each cart."""
        return self.shot_x[0]

    @property
    def slope(self) -> Array:
        """The first velocity (n,) of each cart."""
        return self.shot_v[0]

    @property
    def start_std(self) -> tuple[Array, Array]:
        """Standard errors (n,) of `start` and of `slope` from the first readings.

        They are infinite if the start is fitted.
        """
        known = np.full(self.zero.size, np.inf)
        if self.start_known:
            known[list(self.rows)] = self.sigma
        return known, 2.0 * known / (_SMOOTHING * self.pace)

    @cached_property
    def swing(self) -> Array:
        """Root mean square (rows,) of the readings about their rest."""
        return np.sqrt(np.mean((self.y - self.rest[list(self.rows)][:, None]) ** 2, axis=1))

    @property
    def input(self) -> Array:
        """The input (samples,) at each sample."""
        return np.interp(self.t, self.knots, self.command)

    @cached_property
    def driven(self) -> bool:
        """Whether the input acts during the run."""
        return bool(np.any(self.input))

    def by_cart(self, rows: Array, zero: Array) -> Array:
        """Return the positions (n, samples) for readings (rows, samples) and encoder zeros (n,).

        Carts without readings get the position 0.
        """
        x = np.zeros((zero.size, self.t.size))
        x[list(self.rows)] = rows - zero[list(self.rows)][:, None]
        return x

    def with_noise(self, sigma: Mapping[int, float]) -> "GapRun":
        """Return the run with the noise of some carts replaced; `sigma` is by cart index."""
        own = [sigma.get(row, old) for row, old in zip(self.rows, self.sigma, strict=True)]
        return replace(self, sigma=np.array(own))

    def with_zeros(self, *, width: float) -> "GapRun":
        """Return the run with expected encoder zeros of 0, known to `width` times the noise."""
        std = np.full(self.zero.size, 1.0)
        std[list(self.rows)] = width * self.sigma
        return replace(self, zero=np.zeros(self.zero.size), zero_std=std)

    @cached_property
    def thin(self) -> "GapRun":
        """The run as the fits use it: blocks of fast samples are averaged, the pieces are kept."""
        return _thin(self) if self.block > 1 else self

    @cached_property
    def followed(self) -> PemRunArrays:
        """The run as the prediction-error fit follows it, with neutral parameters of its own."""
        n = self.zero.size
        sampled = 1.0 / float(np.median(np.diff(self.t)))
        # 100 Hz for a bench of carts, which is some twenty readings per swing.
        thin = replace(self, block=max(1, int(sampled * self.pace / 100.0))).thin
        rows, free = list(self.rows), np.array(self.free)
        y, weight = np.zeros((thin.t.size, n)), np.zeros((thin.t.size, n))
        y[:, rows], weight[:, rows] = thin.y.T, (thin.weight / thin.sigma[:, None]).T
        return PemRunArrays(
            t=np.array(thin.t),  # a copy, as numba would compile again for a read-only array
            y=y,
            weight=weight,
            seen=np.isin(np.arange(n), rows) & free,
            free=free,
            guided=np.ascontiguousarray(thin.guided.T),
            knots=np.array(self.knots, dtype=np.float64),
            command=np.array(self.command, dtype=np.float64),
            held=np.zeros((3, 2, self.knots.size)),
            zero=self.zero,
            factor=np.ones(n),
            gain=0.0,
            longest=_LONGEST * self.pace,
        )

    def thinned(self, y: Array) -> Array:
        """Return readings (…, samples) averaged in blocks of samples, see `thin`.

        The mean of a smooth motion exceeds its value in the middle by half the curvature times the
        variance of the times. This excess is subtracted, so the model need not be simulated at
        every sample.
        """
        q, out = self.block, []
        if q == 1:
            return y
        for first, end in pairwise(self.shots):
            last = first + (end - first) // q * q
            times = self.t[first:last].reshape(-1, q)
            middle = times.mean(axis=1)
            mean = y[..., first:last].reshape(*y.shape[:-1], -1, q).mean(axis=-1)
            if middle.size >= 3:  # a curvature needs three blocks
                slope = np.diff(mean) / np.diff(middle)
                curvature = np.diff(slope) / (0.5 * (middle[2:] - middle[:-2]))
                nearest = np.clip(np.arange(middle.size) - 1, 0, middle.size - 3)
                mean = mean - 0.5 * times.var(axis=1) * curvature[..., nearest]
            out += [y[..., first : first + 1], mean]
        return np.concatenate(out, axis=-1)

    @property
    def excitation(self) -> Excitation:
        """The run in the form that the simulator takes.

        Each call makes it again, because it takes twice as much memory as the run.
        """
        return describe_run(
            self.t,
            self.command,
            free=self.free,
            knots=self.knots,
            shots=self.shots,
            guided=self.guided,
        )


def make_run(record: Record, *, n: int, part_of: Record | None = None) -> GapRun:
    """Prepare one record of a bench with n carts.

    `part_of` is the whole record, if this one is a later part of it and so may begin in motion.
    Such a part starts at its first turning point, where no hand can still act. A decay starts after
    the hand has let go; earlier samples are cut.
    """
    in_motion = part_of is not None
    rows = tuple(cart - 1 for cart in record.measured_free)
    y = np.array([record.position(row + 1) for row in rows])
    resolution = np.array([record.encoder_step(row + 1) for row in rows])
    guided = _guided(record, n=n)
    t, u = record.t, record.input
    still = np.maximum(_STILL * resolution, 4.0 * difference_noise(y, order=4))
    # The rest is known only if the carts do not move in the last 12 % of the record.
    tail = y[:, -max(3, int(0.12 * t.size)) :]
    settled = np.ptp(tail, axis=1) <= still
    frequency = _dominant_frequency(t, y)
    # The carts of a bench swing at 8 Hz at most; a faster system gets a smaller pace.
    pace = min(1.0, 8.0 / frequency)
    if record.kind == "decay":
        offset = y - np.where(settled, tail.mean(axis=1), np.median(y, axis=1))[:, None]
        radians = None if in_motion else 2 * np.pi * frequency * record.sample_time
        first = min(_free_from(offset, still, radians=radians), t.size // 2)
        t, u, y, guided = t[first:], u[first:], y[:, first:], guided[:, first:]
    moves = in_motion or record.kind == "decay"
    at_rest, balanced = (False,) * 2 if moves else _begins_at_rest(y, u, still, record.sample_time)
    zero, zero_std, start, slope = np.zeros(n), np.ones(n), np.zeros(n), np.zeros(n)
    ended, own = settled & np.all(u[-tail.shape[1] :] == 0.0), list(rows)
    zero[own] = np.where(ended, tail.mean(axis=1), y[:, 0] if balanced else y.mean(axis=1))
    span = np.ptp(y, axis=1)
    off = np.where(ended | balanced, 0.02, 0.2) * span
    zero_std[own] = np.maximum(np.maximum(off, resolution), 1e-12)
    if at_rest:
        start[own] = y[:, 0]
    else:
        moving = _smooth_states(t, y, np.zeros(1, dtype=np.int64), window=_SMOOTHING * pace)
        start[own], slope[own] = moving[0][:, 0], moving[1][:, 0]
    knots, command = _input_of(part_of or record, before=0.0 if balanced else None)
    rate = 1.0 / float(np.median(np.diff(t)))
    length = max(2, round(_ONE_READING * pace * rate))
    return GapRun(
        id=record.id,
        record=record,
        t=t,
        y=y,
        rows=rows,
        free=tuple(i + 1 in record.free for i in range(n)),
        guided=guided - np.median(guided, axis=1, keepdims=True),
        knots=knots,
        command=command,
        at_rest=at_rest,
        rest=zero,
        zero=zero,
        zero_std=zero_std,
        sigma=np.maximum(resolution / np.sqrt(12.0), 1e-9 * span),
        weight=np.array([_weight(*row, length) for row in zip(y, resolution, strict=True)]),
        block=max(1, int(rate * pace / 250.0)),  # Hz; faster samples are averaged for fits
        pace=pace,
        shots=(0, t.size),
        shot_x=start[None],
        shot_v=slope[None],
    )


def _begins_at_rest(y: Array, u: Array, still: Array, sample_time: float) -> tuple[bool, bool]:
    """Return whether a run starts at rest, and whether it is in equilibrium without an input."""
    # Samples before the input changes. The first two always count, because the input has no effect
    # yet.
    quiet = max(2, int(np.argmax(u != u[0])) + 1)
    # A run without motion in its first 20 ms starts at rest. An input that acts from the first
    # sample moves the carts sooner.
    look = 2 if u[0] != 0.0 else max(2, min(quiet, round(0.02 / sample_time)))
    at_rest = bool(np.all(np.ptp(y[:, :look], axis=1) <= still))
    # A cart that moves before the input changes was held, so it was not in equilibrium.
    in_place = bool(np.all(np.ptp(y[:, :quiet], axis=1) <= still))
    if u[0] == 0.0:
        return at_rest, at_rest and in_place
    # An input that moves the carts at once was switched on with the first sample. If the input
    # changes too soon to tell, carts that rest at zero were not pushed before.
    pushed = in_place and (
        quiet * sample_time > _HELD_STILL or bool(np.any(np.abs(y[:, 0]) > still))
    )
    is_step = bool(np.all(u[:3] == u[0]))
    if pushed or not is_step:
        return at_rest, at_rest and not pushed
    # The carts rested if they have no velocity at the first sample. The step began there, but a log
    # may be a sample late. So the start is fitted.
    first, second = np.diff(y[:, :3], axis=1).T
    return False, bool(np.all(np.abs(1.5 * first - 0.5 * second) <= still))


def _input_of(record: Record, *, before: float | None) -> tuple[Array, Array]:
    """Return knots and the held input of a record, with the input before its first sample.

    By default this is the first input. A band-limited input keeps its mean between knots.
    """
    knots, command = record.t, record.input
    first = float(command[0]) if before is None else before
    if record.hold == "band_limited":
        knots, smooth = interpolate_band_limited(knots, command)
        command = np.append(0.5 * (smooth[1:] + smooth[:-1]), smooth[-1])
    return np.append(knots[0] - record.sample_time, knots), np.append(first, command)


def _guided(record: Record, *, n: int) -> Array:
    """Return the smoothed motion (n, samples) of held carts; zero if it is within rounding."""
    guided = np.zeros((n, record.t.size))
    # A local cubic over 20 ms on either side; a hand allows no faster motion.
    half = max(2, round(0.02 / record.sample_time))
    for cart in record.carts:
        y = record.position(cart)
        if cart not in record.free and np.ptp(y) > _STILL * record.encoder_step(cart):
            from scipy.signal import savgol_filter  # takes half a second, so it is imported here

            guided[cart - 1] = savgol_filter(y, 2 * half + 1, polyorder=3)
    return guided


def _thin(run: GapRun) -> GapRun:
    """Return the run with one reading for each block of samples, at the middle of its times.

    The first sample of each piece defines its state and has no weight.
    """
    q = run.block
    t, weight, shots = [], [], [0]
    for first, end in pairwise(run.shots):
        last = first + (end - first) // q * q
        middle = run.t[first:last].reshape(-1, q).mean(axis=1)
        share = (run.weight[:, first:last] ** 2).reshape(len(run.y), -1, q).mean(axis=2)
        t += [run.t[first : first + 1], middle]
        weight += [np.zeros((len(run.y), 1)), np.sqrt(share)]
        shots.append(shots[-1] + 1 + middle.size)
    side = (1.0 - q**-2) / 24.0  # share of each neighbour's mean in the corrected mean
    return replace(
        run,
        t=np.concatenate(t),
        y=run.thinned(run.y),
        guided=np.array([np.interp(np.concatenate(t), run.t, x) for x in run.guided]),
        weight=np.concatenate(weight, axis=1),
        sigma=run.sigma * np.sqrt(((1.0 + 2.0 * side) ** 2 + 2.0 * side**2) / q),
        block=1,
        shots=tuple(shots),
    )


def _weight(readings: Array, step: float, length: int) -> Array:
    """Return the square root of the weight of each reading of one encoder.

    A cart at rest repeats the same rounding error. So, however long it rests, its readings count as
    `length` readings.
    """
    weight = np.ones(readings.size)
    if step <= 0.0:
        return weight
    first = 0
    low = high = float(readings[0])
    for at, reading in enumerate([*readings.tolist(), np.inf]):
        low, high = min(low, reading), max(high, reading)
        if high - low > _RESTING * step:
            weight[first:at] = np.sqrt(min(1.0, length / (at - first)))
            first, low, high = at, reading, reading
    return weight


def cut_shots(run: GapRun, *, length: float) -> GapRun:
    """Cut a run into pieces, each with its own start state.

    `length` is in s for a bench of carts, and is scaled by the pace.
    """
    count = max(1, round(float(run.t[-1] - run.t[0]) / (length * run.pace)))
    bounds = np.linspace(0, run.t.size, count + 1).astype(int)
    n = run.start.size
    shot_x, shot_v = np.zeros((count, n)), np.zeros((count, n))
    x, v = _smooth_states(run.t, run.y, bounds[:-1], window=_SMOOTHING * run.pace)
    shot_x[:, run.rows], shot_v[:, run.rows] = x.T, v.T
    shot_x[0], shot_v[0] = run.start, run.slope
    return replace(run, shots=tuple(int(b) for b in bounds), shot_x=shot_x, shot_v=shot_v)


def _dominant_frequency(t: Array, y: Array) -> float:
    """Return the frequency, Hz, at which the velocity is strongest."""
    uniform = np.linspace(t[0], t[-1], t.size)
    best, peak = 1.0, 0.0
    for row in y:
        velocity = np.gradient(np.interp(uniform, t, row), uniform)
        power = np.abs(np.fft.rfft(velocity * np.hanning(t.size))) ** 2
        at = int(np.argmax(power[1:])) + 1
        if power[at] > peak:
            best, peak = at / (uniform[-1] - uniform[0]), float(power[at])
    return best


def _free_from(offset: Array, still: Array, *, radians: float | None) -> int:
    """Return the first sample of a decay's free motion.

    `radians` is the phase of the motion per sample. If it is None, the run begins in motion, and
    the result is the first turning point of the cart that moves most.
    """
    leader = int(np.argmax(np.ptp(offset, axis=1) / np.maximum(still, 1e-12)))
    if radians is None:
        turning = extrema(offset[leader], prominence=float(still[leader]))
        return turning[1] if len(turning) > 1 else 0
    motion = np.abs(offset[leader])
    top = int(np.argmax(motion))
    peak = motion[top]
    slack = still[leader] + 0.01 * peak
    held = np.flatnonzero(motion[top:] >= peak - slack)
    gaps = np.flatnonzero(np.diff(held) > 1)
    last = top + int(held[gaps[0]] if gaps.size else held[-1])
    passing = _HELD_TIME * np.sqrt(2.0 * slack / peak) / radians
    if last - top < max(_HELD_SAMPLES, passing):
        # If the carts were shaken, or released before the file begins, no hand acts after the
        # largest swing.
        return last if top > 0 else 0
    # the first turning point after the release, where no hand can still act
    side = np.sign(offset[leader, top])
    return last + int(np.argmin(side * offset[leader, last:]))


def _smooth_states(t: Array, y: Array, at: np.ndarray, *, window: float) -> tuple[Array, Array]:
    """Return positions and velocities (rows, states) at some samples, each from a local cubic."""
    half = max(3, round(window / float(t[1] - t[0])))
    width = min(2 * half + 1, t.size)
    around = np.clip(at - half, 0, t.size - width)[:, None] + np.arange(width)
    local = (t[around] - t[at, None]) / window
    powers = np.vander(local.ravel(), min(4, width)).reshape(*local.shape, -1)
    size = np.sqrt((powers * powers).sum(axis=1))
    bases, smallest = powers / size[:, None], width * np.finfo(np.float64).eps
    # The cubics of np.polyfit, with its checks made once for all states.
    states = [
        [np.linalg.lstsq(basis, row, rcond=smallest)[0][-2:] for row in readings]
        for basis, readings in zip(bases, np.moveaxis(y[:, around], 1, 0), strict=True)
    ]
    slope, position = np.moveaxis(np.array(states) / size[:, None, -2:], (0, 1, 2), (2, 1, 0))
    return position, slope / window


# ------------------------------------------- which records are used, and which runs are held out

_MOST_DWELLS = 4  # sine dwells to use; further ones add little but their frequency
_LEAST_MOTION = 8.0  # encoder steps; a smaller motion is not used
_FEWEST, _SHORTEST = 50, 0.5  # samples, s


def notes_left_out(left_out: Sequence[Finding]) -> list[str]:
    """Return notes on the records that the identification left out."""
    reasons = group_messages((one.experiment, one.reason) for one in left_out)
    return [phrases("gap").text("note_left_out", reason=reason) for reason in reasons]


def prepare(
    records: Sequence[Record],
    *,
    springs: tuple[bool, ...],
    interventions: Sequence[Intervention] = (),
    notes: list[str],
) -> list[GapRun]:
    """Return the runs worth fitting; append a note on each record that is left out.

    The part of a record after an intervention is a separate run.

    Raises
    ------
    DataError : there is no record in which a free cart moves.
    """
    n, words = len(springs) - 1, phrases("gap")
    timed = [r for r in records if r.kind != "bode"]
    usable = [r for r in timed if _is_usable(r)]
    if len(usable) < len(timed):
        unusable = ", ".join(r.id for r in timed if r not in usable)
        notes.append(words.text("note_unusable", runs=unusable))
    if not usable:
        raise DataError(
            "gap: needs a record of half a second or more in which a free cart moves, found none"
        )
    open_loop = [r for r in usable if r.kind != "closed_loop"]
    if open_loop and len(open_loop) < len(usable):
        notes.append(words.text("note_feedback"))
        usable = open_loop
    usable = _with_still_carts_held(usable, notes=notes)
    dwells = [r for r in usable if r.kind == "sine"]
    if len(dwells) > _MOST_DWELLS:
        dwells.sort(key=lambda r: r.omega or 0.0)
        picked = {round(i) for i in np.linspace(0, len(dwells) - 1, _MOST_DWELLS)}
        left_out = {r.id for i, r in enumerate(dwells) if i not in picked}
        usable = [r for r in usable if r.id not in left_out]
        notes.append(words.text("note_dwells", all=len(dwells), used=_MOST_DWELLS))
    runs = [run for record in usable for run in _free_runs(record, interventions, n=n)]
    if not runs:
        raise DataError("gap: no record shows half a second of motion without a hand in it")
    if not any(run.driven for run in runs):
        notes.append(words.text("note_no_input"))
    kept = without_twins(runs)
    if len(kept) < len(runs):
        notes.append(words.text("note_duplicates", count=len(runs) - len(kept)))
    if not any(springs):
        notes.append(words.text("note_no_springs"))
        kept = [_on_no_spring(run) for run in kept]
    return kept


def _free_runs(record: Record, interventions: Sequence[Intervention], *, n: int) -> list[GapRun]:
    """Return the parts of a record between interventions that show motion, each as a run."""
    runs = []
    for piece in between(record, interventions):
        if _is_usable(piece):
            later = piece.t[0] > record.t[0]
            if later:
                let_go = not np.any(piece.input)
                piece = replace(piece, kind="decay" if let_go else "sweep")
            run = make_run(piece, n=n, part_of=record if later else None)
            # A cart that rests until a hand moves it shows nothing.
            if piece.kind != "decay" or _last_away(run):
                runs.append(run)
    return runs


def _on_no_spring(run: GapRun) -> GapRun:
    """Return a run for a bench without springs: its readings are absolute, and its start is known.

    Without springs there is no rest that defines a zero, and a start has a lasting effect. If the
    start were free, it would absorb missing effects.
    """
    # The zero counts as known to a thousandth of the noise.
    known = np.full(run.zero.size, 1e-3 * float(run.sigma.min()))
    return replace(run, start_known=True, zero=np.zeros(run.zero.size), zero_std=known)


def _is_usable(record: Record) -> bool:
    """Return whether a free cart moves, for long enough, under forces that are known."""
    if not record.free or record.t.size < _FEWEST or record.t[-1] - record.t[0] < _SHORTEST:
        return False
    # Without a recorded input, only a release or a run with cart 1 held is usable.
    known = record.u is not None or record.kind == "decay" or 1 not in record.free
    return known and any(
        _span(record, cart) > _LEAST_MOTION * record.encoder_step(cart)
        for cart in record.measured_free
    )


def _span(record: Record, cart: int) -> float:
    return float(np.ptp(record.position(cart)))


def _with_still_carts_held(records: list[Record], *, notes: list[str]) -> list[Record]:
    """Return the records in which carts that never move are marked as held."""
    seen = [(r, cart) for r in records for cart in r.measured_free]
    # A cart whose readings stay within three encoder steps is at rest.
    moving = {cart for r, cart in seen if _span(r, cart) > 3.0 * r.encoder_step(cart)}
    still = {cart for _, cart in seen} - moving
    if not still:
        return records
    carts = " and ".join(f"cart {cart}" for cart in sorted(still))
    notes.append(phrases("gap").text("note_held", carts=carts))
    return [replace(r, free=tuple(c for c in r.free if c not in still)) for r in records]


def split_holdout(runs: list[GapRun], *, notes: list[str]) -> tuple[list[GapRun], list[GapRun]]:
    """Return training and held-out runs; if no run can be spared, cut the longest one in two."""
    teach, judge_by = split(runs)
    if judge_by:
        return [runs[i] for i in teach], [runs[i] for i in judge_by]
    notes.append(phrases("gap").text("note_cut"))
    longest = max(range(len(runs)), key=lambda i: runs[i].t[-1] - runs[i].t[0])
    run = runs[longest]
    moving = max(_last_away(run) or run.t.size, run.t.size // 2)
    cut = int((1.0 - 0.4) * moving)  # the last 40 % of the motion is held out
    pieces, used = [], run.record.part(slice(-run.t.size, None))
    for piece in (slice(0, cut), slice(cut, None)):
        starts = piece.start == 0 and used.kind != "decay"
        # No hand acts in the later piece of a decay.
        kind = used.kind if starts else "sweep"
        record = replace(used.part(piece), kind=kind, reference=None)
        part = make_run(record, n=run.zero.size, part_of=None if starts else run.record)
        pieces.append(
            replace(
                part,
                guided=run.guided[:, piece],
                knots=run.knots,
                command=run.command,
                zero=run.zero,
                zero_std=run.zero_std,
                rest=run.rest,
                start_known=run.start_known,
            )
        )
    others = [r for i, r in enumerate(runs) if i != longest]
    return [*others, pieces[0]], [pieces[1]]


def _last_away(run: GapRun) -> int:
    """Return the number of samples until all carts reach their final position; 0 without motion."""
    step = run.sigma * np.sqrt(12.0)
    away = np.abs(run.y - run.y[:, -1:]) > _LEAST_MOTION * step[:, None]
    return int(np.flatnonzero(away.any(axis=0))[-1]) + 1 if away.any() else 0


def without_twins(runs: Sequence[GapRun]) -> list[GapRun]:
    """Return the runs without exact copies of earlier runs."""
    kept: list[GapRun] = []
    for run in runs:
        if not any(k.y.shape == run.y.shape and np.array_equal(k.y, run.y) for k in kept):
            kept.append(run)
    return kept


def split(runs: Sequence[GapRun]) -> tuple[list[int], list[int]]:
    """Return the indices of training and held-out runs.

    Whole runs are held out, by these rules:

    - Every second repeat is held out.
    - Of three or more sizes of a kind, the middle one is held out, so the extremes are trained on.
    - Of two free decays, the smaller one is held out.
    - At least one run of each kind is trained on.
    - If nothing is held out so far, the smaller of two runs of a kind is, unless both are sweeps.
    - If still nothing is held out, the caller cuts a run in two.
    """
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        groups[run.record.kind, run.free].append(index)
    held: list[int] = []
    pairs: list[list[int]] = []  # two different runs each, held out only as a last resort
    for (kind, _), members in groups.items():
        sizes = {i: _size(runs[i]) for i in members}
        clusters: list[list[int]] = []
        for i in sorted(members, key=lambda i: sizes[i]):
            # Runs whose sizes differ by at most 6 % are repeats.
            if clusters and abs(sizes[i] - sizes[clusters[-1][0]]) <= 0.06 * abs(sizes[i]):
                clusters[-1].append(i)
            else:
                clusters.append([i])
        for cluster in clusters:
            held += cluster[1::2]
        sizes_apart = [cluster[0] for cluster in clusters]
        if len(sizes_apart) >= 3:
            # The order is by signed size, so the extremes of both signs are used for training.
            held.append(sizes_apart[len(sizes_apart) // 2])
        elif len(sizes_apart) == 2 and kind == "decay" and len(members) == 2:
            held.append(min(sizes_apart, key=lambda i: abs(sizes[i])))
        elif len(sizes_apart) == 2:
            pairs.append(sizes_apart)
    # Each of two sweeps may cover what the other lacks, so both are used for training.
    if not held and any(runs[i].record.kind != "sweep" for pair in pairs for i in pair):
        held = [min(pair, key=lambda i: abs(_size(runs[i]))) for pair in pairs[:1]]
    return [i for i in range(len(runs)) if i not in held], sorted(held)


def _size(run: GapRun) -> float:
    """Return how hard a run was driven: its extreme input, or the start of a free decay.

    Under feedback it is the range of the reference, because the reference determines the input.
    """
    if run.record.reference is not None and np.ptp(run.record.reference) > 0.0:
        return float(np.ptp(run.record.reference))
    if run.driven:
        return float(run.input[np.argmax(np.abs(run.input))])
    offset = run.start - run.zero
    return float(offset[np.argmax(np.abs(offset))])


# ------------------------------------------------------------ independent readings of a residual


def independent(residual: Array) -> float:
    """Return the number of independent readings in a residual (samples,).

    A mean square of n correlated points is as certain as one of n / (1 + 2 Σ ρ²) independent
    points. This holds for oscillations, not for a drift.

    Reference: M. S. Bartlett, Journal of the Royal Statistical Society 98 (1935), 536-543.
    """
    power = np.abs(np.fft.rfft(residual - residual.mean(), 2 * residual.size)) ** 2
    covariance = np.fft.irfft(power)[: residual.size]
    if covariance[0] <= 0.0:
        return float(residual.size)
    correlation = covariance[1:] / covariance[0]
    return residual.size / (1.0 + 2.0 * float((correlation**2).sum()))
