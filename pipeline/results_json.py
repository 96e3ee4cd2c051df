"""`results.json`: the analysis as other programs read it. Same input, same bytes."""

import json
import math
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.plant.chain import Chain
from pipeline.results import (
    Analysis,
    FeedbackDesign,
    FrequencyResponse,
    HardwareCheck,
    LogDecrement,
    ParameterRow,
)

SCHEMA = "cartlab-results/1"
_DIGITS = 10  # significant: below that, processors and library versions differ


def results_dict(analysis: Analysis) -> dict[str, Any]:
    """Return the analysis as plain numbers, lists and strings; what could not be had is None."""
    position, drive = analysis.position_unit, analysis.input_unit
    return {
        "schema": SCHEMA,
        "submission": {
            "title": analysis.title,
            "section": analysis.section,
            "authors": [id_ for id_, _ in analysis.authors],
            "carts": analysis.carts,
            "springs": list(analysis.springs),
            "units": {"position": position, "input": drive},
        },
        "parameters": [_row(row) for row in analysis.rows],
        "chain": analysis.chain and _chain(analysis.chain, position=position, drive=drive),
        "state_space": analysis.chain and _state_space(analysis.chain),
        "fit": analysis.fit
        and {
            "method": analysis.fit.method,
            "chi_square_per_dof": analysis.fit.chi_square_per_dof,
            "dof": analysis.fit.dof,
            "points": analysis.fit.n_points,
            "starts": analysis.fit.n_starts,
            "converged": analysis.fit.converged,
            "message": analysis.fit.message,
        },
        "log_decrements": [_log_decrement(decay) for decay in analysis.log_decrements],
        "step_gains": [
            {
                "experiment": step.experiment,
                "cart": step.cart,
                "gain": step.gain,
                "gain_std": step.gain_std,
                "interval": step.interval,
                "rest_shift": step.rest_shift,
                "note": step.note,
            }
            for step in analysis.step_gains
        ],
        "frequency_response": [_response(response) for response in analysis.frequency_responses],
        "checks": [
            {
                "id": check.id,
                "outcome": check.outcome,
                "value": check.value,
                "limit": check.limit,
                "message": check.message,
            }
            for check in analysis.checks
        ],
        "feedback": analysis.feedback and _feedback(analysis.feedback),
        "hardware": _hardware(analysis.hardware),
        "skipped": [{"stage": skip.stage, "reason": skip.reason} for skip in analysis.skipped],
        "warnings": list(analysis.warnings),
        "provenance": {"version": __version__, "files": dict(sorted(analysis.files.items()))},
    }


def results_text(analysis: Analysis) -> str:
    """Return `results.json` as text, numbers at ten significant digits."""
    plain = plain_json(results_dict(analysis))
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _row(row: ParameterRow) -> dict[str, Any]:
    fields: dict[str, Any] = {"name": row.name, "unit": row.unit}
    for key, estimate in (("initial", row.initial), ("final", row.final)):
        fields[key] = estimate and estimate.value
        fields[f"{key}_std"] = estimate and estimate.std
        fields[f"{key}_from"] = estimate and estimate.source
    return fields | {
        "change_percent": row.change_percent,
        "change_sigmas": row.change_sigmas,
        "consistent": row.consistent,
        "note": row.note,
    }


def _chain(chain: Chain, *, position: str, drive: str) -> dict[str, Any]:
    units = {
        "m": f"{drive} s^2/{position}",
        "c": f"{drive} s/{position}",
        "k": f"{drive}/{position}",
    }
    return {"m": chain.m, "c": chain.c, "k": chain.k, "units": units}


def _state_space(chain: Chain) -> dict[str, Any]:
    return dict(zip("ABCD", chain.state_space(), strict=True))


def _log_decrement(decay: LogDecrement) -> dict[str, Any]:
    friction = decay.friction
    return {
        "experiment": decay.experiment,
        "cart": decay.cart,
        "delta": decay.delta,
        "delta_std": decay.delta_std,
        "omega_n": decay.omega_n,
        "omega_n_std": decay.omega_n_std,
        "zeta": decay.zeta,
        "zeta_std": decay.zeta_std,
        "omega_n_peaks": decay.omega_n_peaks,
        "zeta_peaks": decay.zeta_peaks,
        "zeta_peaks_std": decay.zeta_peaks_std,
        "friction": friction
        and {
            "present": friction.present,
            "f_statistic": friction.f_statistic,
            "threshold": friction.threshold,
            "drop": friction.drop,
            "drop_std": friction.drop_std,
            "zeta": friction.zeta,
            "zeta_std": friction.zeta_std,
        },
        "note": decay.note,
    }


def _response(response: FrequencyResponse) -> dict[str, Any]:
    return {
        "cart": response.cart,
        "omega": response.omega,
        "magnitude": response.magnitude,
        "magnitude_std": response.magnitude_std,
        "phase": response.phase,
        "phase_std": response.phase_std,
        "source": response.source,
    }


def _feedback(design: FeedbackDesign) -> dict[str, Any]:
    return {
        "cart": design.cart,
        "method": design.method,
        "reference": design.reference,
        "gains": design.gains,
        "prefilter": design.prefilter,
        "poles": [[pole.real, pole.imag] for pole in design.poles],
        "sample_time": design.sample_time,
        "overshoot_percent": design.overshoot_percent,
        "settling_time": design.settling_time,
        "peak_input": design.peak_input,
        "margins": design.margins and vars(design.margins),
        "reachable": design.reachable,
        "message": design.message,
    }


def _hardware(checks: tuple[HardwareCheck, ...]) -> list[dict[str, Any]]:
    """One entry a run and cart: the loop that ran, with the measured-input check inside it."""
    entries: dict[tuple[str, int], dict[str, Any]] = {}
    for check in sorted(checks, key=lambda check: check.loop):  # "closed" before "open"
        measured_input = {"nrmse": check.nrmse, "input_scale": check.input_scale}
        key = (check.experiment, check.cart)
        if key in entries:
            entries[key]["measured_input"] = measured_input
            continue
        entries[key] = {
            "experiment": check.experiment,
            "cart": check.cart,
            "loop": check.loop,
            "nrmse": check.nrmse,
            "overshoot_model": check.overshoot_model,
            "overshoot_measured": check.overshoot_measured,
            "settling_time_model": check.settling_model,
            "settling_time_measured": check.settling_measured,
            "steady_state_model": check.steady_state_model,
            "steady_state_measured": check.steady_state_measured,
            "measured_input": measured_input if check.loop == "open" else None,
            "note": check.note,
        }
    return [entries[key] for key in sorted(entries)]


def plain_json(value: Any) -> Any:
    """Return JSON's own types, floats at `_DIGITS` significant digits, NaN and infinity as None."""
    match value:
        case dict():
            return {key: plain_json(item) for key, item in value.items()}
        case list() | tuple():
            return [plain_json(item) for item in value]
        case np.ndarray():
            return plain_json(value.tolist())
        case bool() | None | str() | int():
            return value
        case np.bool_():
            return bool(value)
        case np.integer():
            return int(value)
        case _ if math.isfinite(value):
            return float(f"{value:.{_DIGITS}g}") + 0.0  # no minus zero
        case _:
            return None
