"""Which measurements determine each resonance and null of a fitted chain.

A fit of few parameters predicts a resonance even from data far away from it. This prediction relies
on the structure of the chain, so its standard error says nothing about a wrong structure. A number
counts as measured only if there are measurements at its own frequency.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.noise import local_noise
from pipeline.names import own_omega, read_name
from pipeline.results import ChainFit, Coverage, FrequencyResponse, Record

# Measurements must be within five half-widths (ζω) on both sides of a frequency, where a mode still
# has a fifth of its peak, but not closer than the first or farther than the second of these shares.
_HALF_WIDTHS, _NEAREST_LIMIT, _FARTHEST_LIMIT = 5.0, 0.1, 0.3
# Largest relative standard error of a point that shows the height of a peak.
_LARGEST_RELATIVE_STD = 0.2
# A line of a spectrum is motion if it exceeds the noise by this factor. Noise alone does so once in
# e^12.5 lines.
_VISIBLE = 5.0


def points_measured(responses: Iterable[FrequencyResponse]) -> Array:
    """Return the frequencies, rad/s, at which a frequency response has a point above its error."""
    seen = [np.zeros(0)]
    for r in responses:
        # A table states no errors; NaN counts as seen.
        hidden = r.magnitude_std > _LARGEST_RELATIVE_STD * r.magnitude
        seen.append(r.omega[~hidden & (r.omega > 0)])
    return np.unique(np.concatenate(seen))


def motion_measured(records: Iterable[Record]) -> Array:
    """Return the frequencies, rad/s, at which the motion in some record exceeds its noise."""
    return np.unique(np.concatenate([np.zeros(0), *map(_visible, records)]))


def _visible(record: Record) -> Array:
    n, dt = record.t.size, record.sample_time
    even = np.linspace(record.t[0], record.t[-1], n)
    window = np.hanning(n)
    # Padded to twice the length, so that the lines are half a resolution apart.
    omega: Array = 2 * np.pi * np.fft.rfftfreq(2 * n, dt).astype(np.float64)
    seen = np.zeros(omega.size, dtype=bool)
    for y, step in zip(record.y, record.resolution, strict=True):
        noise = max(local_noise(record.t, y), float(step) / np.sqrt(12))
        motion = np.interp(even, record.t, y)
        spectrum = np.abs(np.fft.rfft((motion - motion.mean()) * window, 2 * n))
        seen |= spectrum > _VISIBLE * noise * np.linalg.norm(window)
    # The lowest lines hold the mean and the drift.
    return omega[seen & (omega > 4 * np.pi / (n * dt))]


def with_coverage(fit: ChainFit, measured: Array) -> ChainFit:
    """Return the fit; each frequency and damping ratio has its `Coverage`.

    Frequencies of carts held alone that are no null follow from all resonances and nulls, so they
    have the worst coverage of these. A damping ratio from decays is measured and gets none.

    Parameters
    ----------
    measured : (n,) ascending frequencies with a measurement, rad/s.
    """
    found = fit.parameters
    omegas = [name for name in found if read_name(name).is_frequency]
    seen: dict[str, Coverage] = {}
    for name in omegas:
        zeta = found.get(read_name(name).damping)
        if _is_root(name, n=fit.chain.n) and found[name].value > 0:
            seen[name] = _coverage(
                name, omega=found[name].value, zeta=zeta.value if zeta else 0.0, measured=measured
            )
    if not seen:
        return fit
    worst = max(seen.values(), key=lambda one: one.distance / one.limit)
    by_name = {
        name: seen.get(omega, worst)
        for omega in omegas
        for name in (omega, read_name(omega).damping)
        if name in found and found[name].source == fit.method
    }
    covered = {name: replace(found[name], coverage=one) for name, one in by_name.items()}
    return replace(fit, parameters={**found, **covered})


def _is_root(omega: str, *, n: int) -> bool:
    """Whether a frequency is that of a pole or zero of a measured response."""
    read = read_name(omega)
    return read.is_by_eye or omega == own_omega(n, n=n)


def _coverage(name: str, *, omega: float, zeta: float, measured: Array) -> Coverage:
    half_width = max(zeta, 0.0) * omega

    def nearest(there: Array) -> float | None:
        return float(there[np.argmin(np.abs(there - omega))]) if there.size else None

    return Coverage(
        of=name,
        omega=omega,
        half_width=half_width,
        # A point on the peak, within a half-width, counts as a point on both sides.
        below=nearest(measured[measured <= omega + half_width]),
        above=nearest(measured[measured >= omega - half_width]),
        limit=float(np.clip(_HALF_WIDTHS * zeta, _NEAREST_LIMIT, _FARTHEST_LIMIT)),
    )
