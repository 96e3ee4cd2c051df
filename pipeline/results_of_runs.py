"""The map's first part: a recording, and what the stages read off it alone.

Units, axes and errors are those of `pipeline.results`, where the map goes on.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.arrays import Array, freeze

Kind = Literal["decay", "step", "sine", "sweep", "closed_loop", "bode"]
Hold = Literal["zero_order", "band_limited"]


@dataclass(frozen=True, kw_only=True)
class HeadingUnit:
    """A unit that a heading states; `converts`: into the submission's, else it was not heeded."""

    role: Literal["position", "input"]
    heading: str
    unit: str
    converts: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """One measured time series, in physical units.

    Attributes
    ----------
    id : the experiment's id, used in every message.
    t : (n,) s, strictly increasing, as measured: never assumed uniform.
    u : (n,) input, or None where the file has none. Positive pushes cart 1 towards positive x.
    y : (len(carts), n) positions; row j belongs to cart `carts[j]`.
    carts : the carts that were measured.
    free : the carts free to move; the others are held.
    reference : (n,) set point of a closed-loop run, in position units, or None.
    omega : frequency of a sine dwell, rad/s, or None.
    resolution : (len(carts),) the encoder step, in position units; 0 where none is seen.
    hold : how the input behaves between samples.
    source : path inside the submission; `notes` say what reading it had to mend.
    turned : its input was found to count the other way than the bench's others, and was turned.
    position_scale, input_scale : what the file's own numbers were multiplied by to get y and u
        (the sign included); a controller's gains may be in the file's units.
    heading_units : what the headings of positions and input state.
    """

    id: str
    kind: Kind
    t: Array
    u: Array | None
    y: Array
    carts: tuple[int, ...]
    free: tuple[int, ...]
    reference: Array | None = None
    omega: float | None = None
    resolution: Array
    hold: Hold = "zero_order"
    source: str = ""
    notes: tuple[str, ...] = ()
    turned: bool = False
    position_scale: float = 1.0
    input_scale: float = 1.0
    heading_units: tuple[HeadingUnit, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "t", "u", "y", "reference", "resolution")
        n = self.t.size
        if self.y.shape != (len(self.carts), n) or self.resolution.shape != (len(self.carts),):
            raise ValueError(f"{self.id}: y {self.y.shape} does not match carts and t ({n},)")
        if any(a is not None and a.shape != (n,) for a in (self.u, self.reference)):
            raise ValueError(f"{self.id}: the input or reference does not match t ({n},)")

    def position(self, cart: int) -> Array:
        """Return the measured position (n,) of one cart."""
        return self.y[self.carts.index(cart)]

    def encoder_step(self, cart: int) -> float:
        """Return the encoder step of one cart, in position units; 0 where none is seen."""
        return float(self.resolution[self.carts.index(cart)])

    @property
    def sample_time(self) -> float:
        """The mean sample interval, s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))


@dataclass(frozen=True, kw_only=True)
class Intervention:
    """A stretch of a record, `start` to `end` in s, in which an unmeasured force moves a cart.

    A hand, most likely; or one holds the cart away from its rest until it lets go.
    """

    experiment: str
    cart: int
    start: float
    end: float
    what: str = "held or moved by a force that was not measured"


@dataclass(frozen=True, kw_only=True, eq=False)
class SinePoint:
    """Sinusoidal steady state of one cart in one dwell.

    Attributes
    ----------
    omega : rad/s; fitted where the submission did not state it.
    amplitude, phase : of the position; phase in rad against the input's sine, in (-pi, pi].
    input_amplitude : of the measured input, fitted the same way.
    steady_from : s; the transient is over, the fit uses t >= steady_from.
    settled : False where the record ends before a steady state is seen.
    note : what a reader must know (few counts, not settled, off-sine residual), or "".
    """

    experiment: str
    cart: int
    omega: float
    amplitude: float
    amplitude_std: float
    phase: float
    phase_std: float
    input_amplitude: float
    input_amplitude_std: float
    steady_from: float
    settled: bool
    n_points: int
    note: str = ""

    @property
    def gain(self) -> float:
        """Amplitude ratio, position unit per input unit."""
        return self.amplitude / self.input_amplitude

    @property
    def gain_std(self) -> float:
        """Standard error of the amplitude ratio, both amplitudes' errors combined."""
        relative = (
            (self.amplitude_std / self.amplitude) ** 2
            + (self.input_amplitude_std / self.input_amplitude) ** 2
            if self.amplitude > 0
            else 0.0
        )
        return self.gain * relative**0.5 if self.amplitude > 0 else self.amplitude_std


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionTest:
    """Does dry friction explain the decay better than viscous damping alone?

    Attributes
    ----------
    f_statistic, threshold : the F-test of one further parameter; `present` if above.
    drop : d = F/k, the friction band's half width, position units.
    zeta : of the decay once friction is taken out.
    """

    f_statistic: float
    threshold: float
    present: bool
    drop: float
    drop_std: float
    zeta: float
    zeta_std: float


@dataclass(frozen=True, kw_only=True, eq=False)
class LogDecrement:
    """Free decay of one cart: peaks, envelope, natural frequency and damping ratio.

    Attributes
    ----------
    number : which of the record's decays, from 1; None where there is one only.
    release : s; where the free decay begins (a hold or a hand may come before it).
    peak_t, peak_y : (n_peaks,) the extrema used, maxima and minima in turn.
    amplitude : (n_peaks - 2,) half the swing about the moving rest point, at peak_t[1:-1].
    delta, zeta_peaks, omega_n_peaks : by the logarithmic decrement (per full cycle).
    zeta, omega_n : by the exponential-sinusoid fit, the better estimate.
    fit_t, fit_y : the fitted decay, for the figure; envelope_upper/lower at fit_t.
    friction : the dry-friction test; with friction present zeta is biased, and `note` says so.
    zeta_at_amplitude : (2, n) amplitude and the local damping ratio there.
    """

    experiment: str
    cart: int
    number: int | None = None
    release: float
    peak_t: Array
    peak_y: Array
    amplitude: Array
    delta: float
    delta_std: float
    zeta_peaks: float
    zeta_peaks_std: float
    omega_n_peaks: float
    omega_n_peaks_std: float
    zeta: float
    zeta_std: float
    omega_n: float
    omega_n_std: float
    fit_t: Array
    fit_y: Array
    envelope_upper: Array
    envelope_lower: Array
    friction: FrictionTest | None
    zeta_at_amplitude: Array
    note: str = ""

    @property
    def name(self) -> str:
        """The record's id, and which of its decays it is."""
        return f"{self.experiment}, decay {self.number}" if self.number else self.experiment


@dataclass(frozen=True, kw_only=True, eq=False)
class StepEdge:
    """One edge of the input and the levels on its two sides.

    `gain` is (level_after - level_before) / (u_after - u_before); windows in s.
    """

    t: float
    u_before: float
    u_after: float
    level_before: float
    level_after: float
    window_before: tuple[float, float]
    window_after: tuple[float, float]
    gain: float
    gain_std: float


@dataclass(frozen=True, kw_only=True, eq=False)
class StepGain:
    """Static gain of one cart from one step record.

    Attributes
    ----------
    gain : weighted mean over the edges; gain_std its standard error, spread included.
    rest_shift : how far the rest point moved between first and last rest (friction), or None.
    interval : (low, high) of the gain where the cart sticks, else None.
    """

    experiment: str
    cart: int
    edges: tuple[StepEdge, ...]
    gain: float
    gain_std: float
    rest_shift: float | None
    interval: tuple[float, float] | None
    note: str = ""
