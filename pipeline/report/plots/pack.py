"""Pack runs as compact text for a page: every peak is kept, and each number takes sixteen bits."""

from base64 import b64encode
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.report.plots.runs import ComparedCart, ComparedRun
from pipeline.report.plots.spectrum import amplitude_spectrum, thin_lines
from pipeline.words.text import clean

MOST_WHOLE = 4_000  # most samples of a run that is shown completely
# A longer run is divided into this number of stretches; each keeps its ends and extremes.
_STRETCHES = 1_000
_LEVELS = 65_534  # levels of a packed number; the level below them marks a missing number
_SMALLEST = 1e-12  # share of the largest amplitude; smaller amplitudes are drawn at this level


def pack_run(run: ComparedRun) -> dict[str, Any]:
    """Return a run in the form that the page's script reads.

    Positions and residuals are packed separately, so that residuals keep all digits. The script
    computes each model as position minus residual.
    """
    signals = [cart.measured for cart in run.carts]
    signals += [cart.measured - one.y for cart in run.carts for one in cart.models]
    signals += [run.u] if run.u is not None else []
    kept = keep_extremes(signals) if run.t.size > MOST_WHOLE else np.arange(run.t.size)
    omega, spectra = _spectra(run)
    return {
        "id": clean(run.id),
        "kind": run.kind,
        "note": clean(run.note),
        "t": pack_time(run.t[kept]),
        "u": None if run.u is None else pack(run.u[kept]),
        "omega": pack(omega),
        "carts": [
            {
                "cart": cart.cart,
                "y": pack(cart.measured[kept]),
                "spectrum": next(spectra),
                "models": [
                    {
                        "model": one.model,
                        "nrmse": float(f"{one.nrmse:.6g}"),
                        "residual": pack((cart.measured - one.y)[kept]),
                        "spectrum": next(spectra),
                        "residual_spectrum": next(spectra),
                    }
                    for one in cart.models
                ],
            }
            for cart in run.carts
        ],
    }


def keep_extremes(signals: Sequence[Array]) -> NDArray[np.intp]:
    """Return the indices (k,) of the samples at the ends and extremes of every stretch."""
    bounds = np.linspace(0, signals[0].size, _STRETCHES + 1).astype(int)
    kept = [bounds[:-1], bounds[1:] - 1]
    for signal in signals:
        for fill, extreme in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            filled = np.where(np.isnan(signal), fill, signal)
            pieces = pairwise(bounds.tolist())
            kept.append(np.array([a + extreme(filled[a:b]) for a, b in pieces]))
    return np.unique(np.concatenate(kept))


def pack(values: Array) -> list[Any]:
    """Return numbers as [middle, step, base64 of little-endian int16].

    The lowest int16 marks NaN.
    """
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    step = (high - low) / _LEVELS
    middle = low + step * (_LEVELS // 2)
    shown = np.where(np.isfinite(values), values, middle)
    levels = np.round((shown - middle) / step) if step > 0.0 else np.zeros(values.size)
    levels = np.where(np.isfinite(values), np.clip(levels, -32767, 32767), -32768)
    return [middle, step, b64encode(levels.astype("<i2").tobytes()).decode()]


def pack_time(values: Array) -> str:
    """Return times as "first last" if they are evenly spaced, else as base64 of float32."""
    if values.size > 1:
        even = np.linspace(values[0], values[-1], values.size)
        # A sample that deviates by less than this share of the span still looks evenly spaced.
        if np.max(np.abs(values - even)) <= 1e-5 * abs(even[-1] - even[0]):
            return f"{float(values[0]):.9g} {float(values[-1]):.9g}"
    return b64encode(values.astype("<f4").tobytes()).decode()


def _spectra(run: ComparedRun) -> tuple[Array, Any]:
    """Return frequencies (k,), and an iterator over the packed spectra in the page's order.

    Spectra are logarithms to base ten. If the simulation of a model begins later than the run, all
    spectra begin there too.
    """
    signals = [signal for cart in run.carts for signal in _signals_of(cart)]
    first = max((int(np.argmax(np.isfinite(one))) for one in signals), default=0)
    if run.t.size - first < 4 or not signals:
        return np.zeros(0), iter([pack(np.zeros(0))] * len(signals))
    omega, amplitudes = amplitude_spectrum(run.t[first:], np.array([s[first:] for s in signals]))
    kept, shown = thin_lines([amplitudes.max(axis=0), *amplitudes])
    least = _SMALLEST * max(float(amplitudes.max()), 1e-300)
    return omega[kept], iter([pack(np.log10(np.maximum(one, least))) for one in shown[1:]])


def _signals_of(cart: ComparedCart) -> list[Array]:
    """Return the measured signal, then each model's positions and residuals."""
    pairs = [(one.y, cart.measured - one.y) for one in cart.models]
    return [cart.measured, *(signal for pair in pairs for signal in pair)]
