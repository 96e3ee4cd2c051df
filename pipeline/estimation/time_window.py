"""The part of a record that a chain can explain, and how well a given chain explains it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.modal_response import Modes, drive_modes
from pipeline.estimation.noise import local_noise, noise_beyond_rounding, rounding_left
from pipeline.plant.simulate import OVERSAMPLING, interpolate_band_limited
from pipeline.results import ExperimentKind, Record

# A free decay is used after its largest swing has fallen to this share, because the hand or stop
# has then let go of the cart.
_RELEASED_BELOW = 0.5
_FEWEST_SAMPLES = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class FitWindow:
    """The part of a record that the fit uses.

    Attributes
    ----------
    t : times (n,), s, from 0.
    y : positions (p, n) of the free measured carts.
    drive_t, drive_u : times and values (n_d,) of the held input, on a grid `stride` times finer
        than t. Without an input on a free cart, drive_u is None.
    carts, free : measured and free carts, as in `Record` but without held carts.
    stated_sigma : standard error (p,) of a position, from encoder step and local noise.
    sigma : standard error (p,) used for the weights, at least `stated_sigma`.
    step : encoder steps (p,), position units; zero if unknown.
    at_rest : whether the carts start at rest. Otherwise position and speed at t = 0 are unknown.
    shared : variance (p,), over sigma², of the error that all readings before the input share.
        While nothing moves, the encoder always rounds in the same way.
    """

    id: str
    kind: ExperimentKind
    t: Array
    y: Array
    drive_t: Array
    drive_u: Array | None
    stride: int
    carts: tuple[int, ...]
    free: tuple[int, ...]
    stated_sigma: Array
    sigma: Array
    step: Array
    at_rest: bool
    shared: Array | float = 0.0

    @property
    def n_resting(self) -> int:
        """Number of samples before the input begins; 0 without an input."""
        if self.drive_u is None or not np.any(self.drive_u):
            return 0
        return int(np.searchsorted(self.t, self.drive_t[np.flatnonzero(self.drive_u)[0]]))

    def rms_in_motion(self, residual: Array) -> Array:
        """Return the root mean square (p,) of residuals (p, n) after the input begins.

        Before the input begins, it is chance whether an encoder flickers between two counts or
        stays on one.
        """
        return np.sqrt(np.mean(residual[:, self.n_resting :] ** 2, axis=1))

    def informed(self, residual: Array, *, at_rest: bool) -> "FitWindow":
        """Return this window with its standard errors taken from the residuals of a fit.

        No standard error falls below the stated one.

        Parameters
        ----------
        residual : residuals (p, n), position units.
        """
        sigma = np.maximum(self.stated_sigma, np.sqrt(np.mean(residual**2, axis=1)))
        moving = self.rms_in_motion(residual)
        left = [
            rounding_left(noise_beyond_rounding(rms, step=step), step=step)
            for rms, step in zip(moving.tolist(), self.step.tolist(), strict=True)
        ]
        shared = (np.array(left) * self.step / sigma) ** 2 / 12 if at_rest else 0.0
        return replace(self, sigma=sigma, at_rest=at_rest, shared=shared)

    def thinned(self, most: int) -> "FitWindow":
        """Return this window with at most 2 × `most` samples; the input keeps all samples."""
        step = max(self.t.size // most, 1)
        return replace(self, t=self.t[::step], y=self.y[:, ::step], stride=self.stride * step)


@dataclass(frozen=True, kw_only=True, eq=False)
class Misfit:
    """Residuals of a chain in one window, with the best start and encoder zeros.

    Attributes
    ----------
    residual : (p, n), model minus measured, over sigma.
    jacobian : derivatives (n_p, p, n) of the residual with respect to theta. The nuisance
        parameters (start and encoder zeros) are adjusted along with theta.
    n_nuisance : number of eliminated nuisance parameters.
    """

    residual: Array
    jacobian: Array
    n_nuisance: int

    @cached_property
    def triangle(self) -> Array:
        """The triangle of a QR decomposition of Jacobian and residual, the residual last."""
        jacobian = self.jacobian.reshape(self.jacobian.shape[0], -1)
        columns = np.vstack([jacobian, self.residual.reshape(1, -1)]).T
        return np.asarray(np.linalg.qr(columns, mode="r"))


def usable_segment(record: Record) -> slice:
    """Return the samples of a record that a linear chain can explain.

    For a driven record these are all samples. For a decay they begin after the release, when the
    largest swing about the final rest has halved. The hand or stop has then let go of the cart.

    Raises
    ------
    DataError : nothing moves, or no sample remains after the release.
    """
    if record.kind != "decay":
        return slice(0, record.t.size)
    rest = np.median(record.y[:, -max(record.t.size // 10, 1) :], axis=1)
    swing = np.max(np.abs(record.y - rest[:, None]), axis=0)
    if not np.max(swing) > 3 * np.max(record.resolution, initial=0.0):
        raise DataError(f"{record.id}: time fit needs a cart that moves, found none")
    # The hold ends when the swing falls below 95 % of its largest value.
    held_until = int(np.flatnonzero(swing >= 0.95 * swing.max())[-1])
    released = np.flatnonzero(swing[held_until:] < _RELEASED_BELOW * swing.max())
    start = held_until + int(released[0]) if released.size else record.t.size
    if record.t.size - start < _FEWEST_SAMPLES:
        raise DataError(
            f"{record.id}: time fit needs {_FEWEST_SAMPLES} samples after the release, "
            f"found {record.t.size - start}"
        )
    return slice(start, record.t.size)


def open_window(record: Record) -> FitWindow:
    """Prepare a record for the fit.

    Raises
    ------
    DataError : no free cart was measured, a cart stands still (it sticks, or its encoder is dead),
        or too few samples are usable.
    """
    carts = tuple(cart for cart in record.carts if cart in record.free)
    used = usable_segment(record)
    t, y = record.t[used], np.array([record.position(cart)[used] for cart in carts])
    if not carts or t.size < _FEWEST_SAMPLES:
        raise DataError(
            f"{record.id}: time fit needs {_FEWEST_SAMPLES} samples of a free cart, found "
            f"{t.size if carts else 0}"
        )
    for cart, position in zip(carts, y, strict=True):
        if not np.ptp(position) > record.encoder_step(cart):
            raise DataError(f"{record.id}: time fit needs carts that move, cart {cart} does not")
    drive_t, drive_u, stride = t - t[0], None, 1
    if 1 in record.free and record.u is not None and np.any(record.u[used]):
        drive_u = record.u[used]
        if record.hold == "band_limited":
            fine_t, fine_u = interpolate_band_limited(drive_t, drive_u)
            # Holding the value at the middle of an eight times finer step has an error of (omega dt
            # / 8)² / 24.
            drive_t, stride = fine_t, OVERSAMPLING
            drive_u = np.append((fine_u[1:] + fine_u[:-1]) / 2, fine_u[-1])
    steps = np.array([record.encoder_step(cart) for cart in carts])
    noise = np.array([local_noise(t, position) for position in y])
    # The error assumed, from the motion's range, if the data show neither noise nor encoder steps.
    least = 1e-6 * float(np.max(np.ptp(y, axis=1)))
    sigma = np.maximum(np.maximum(noise, steps / np.sqrt(12)), least)
    return FitWindow(
        id=record.id,
        kind=record.kind,
        t=t - t[0],
        y=y,
        drive_t=drive_t,
        drive_u=drive_u,
        stride=stride,
        carts=carts,
        free=tuple(sorted(record.free)),
        stated_sigma=sigma,
        sigma=sigma,
        step=steps,
        at_rest=False,
    )


def compare(window: FitWindow, modes: Modes) -> Misfit:
    """Compare a chain, given by its modes, with a window.

    Start and encoder zeros enter linearly, so they are eliminated: residual and Jacobian are
    projected onto the rest of the space. This is variable projection in Kaufman's form (G. Golub &
    V. Pereyra, Inverse Problems 19, 2003, section 3).
    """
    p, n = window.y.shape
    rows = [window.free.index(cart) for cart in window.carts]
    shapes, d_shapes = modes.shapes[rows], modes.d_shapes[:, rows]
    free_motion = np.exp(modes.poles[:, None] * window.t)  # (n_m, n)
    columns = [np.repeat(np.eye(p)[:, :, None], n, axis=2)]  # encoder zeros
    if not window.at_rest:
        start = modes.entry.T[:, None] * shapes  # (2f, p, n_m)
        columns.append(_real_part(start, free_motion))
    local = weighed(np.concatenate(columns), window).reshape(-1, p * n).T
    scale = np.linalg.norm(local, axis=0)
    scale[scale == 0] = 1.0
    Q, R = np.linalg.qr(local / scale)
    U, s, Vt = np.linalg.svd(R)
    # Below this relative singular value, two nuisance parameters have the same effect.
    kept = s > 1e-9 * s[0]
    basis = Q @ U[:, kept]

    signals, d_weights = [], []  # modal signals, and their weights in the Jacobian
    rest = -window.y
    if window.drive_u is not None:
        q, dq = drive_modes(modes.poles, window.drive_t, window.drive_u)
        signals += [q[:, :: window.stride], dq[:, :: window.stride]]
        by_shape = shapes * modes.drive
        rest = rest + _real_part(by_shape, signals[0])
        d_weights += [
            d_shapes * modes.drive + shapes * modes.d_drive[:, None],
            by_shape * modes.d_poles[:, None],
        ]
    rest = weighed(rest, window).reshape(-1)
    along = basis.T @ rest
    if not window.at_rest:
        found = -(Vt[kept].T @ (along / s[kept])) / scale
        x0 = found[p:]
        z0, d_z0 = modes.entry @ x0, modes.d_entry @ x0
        signals += [free_motion, free_motion * window.t]
        d_weights += [d_shapes * z0 + shapes * d_z0[:, None], shapes * z0 * modes.d_poles[:, None]]
    n_p = modes.d_poles.shape[0]
    if signals:
        jacobian = _real_part(np.concatenate(d_weights, axis=2), np.concatenate(signals))
    else:
        jacobian = np.zeros((n_p, p, n))
    jacobian = weighed(jacobian, window).reshape(n_p, p * n)
    jacobian = jacobian - (jacobian @ basis) @ basis.T
    return Misfit(
        residual=(rest - basis @ along).reshape(p, n),
        jacobian=jacobian.reshape(n_p, p, n),
        n_nuisance=int(np.count_nonzero(kept)),
    )


def weighed(values: Array, window: FitWindow) -> Array:
    """Return values (…, p, n) over sigma, whitened before the input begins.

    The n readings until then have a common error. Their covariance matrix has the eigenvalue
    1 + n shared along the vector of ones, and 1 in all other directions.
    """
    scaled = values / window.sigma[:, None]
    if np.any(window.shared) and (n := window.n_resting):
        mean = np.mean(scaled[..., :n], axis=-1)
        scaled[..., :n] -= (mean * (1 - 1 / np.sqrt(1 + n * window.shared)))[..., None]
    return scaled


def _real_part(weights: ComplexArray, signals: ComplexArray) -> Array:
    """Return Re(weights @ signals) for (…, n_m) and (n_m, n), by one real product."""
    return np.concatenate([weights.real, -weights.imag], axis=-1) @ np.concatenate(
        [signals.real, signals.imag]
    )
