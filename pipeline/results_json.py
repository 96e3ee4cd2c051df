"""`results.json`: the analysis as other programs read it. Same input, same bytes."""

from typing import Any

from pipeline import __version__
from pipeline.plant.linear.chain import Chain
from pipeline.results import Analysis, HardwareCheck, LogDecrement, ParameterRow
from pipeline.schemas import results as schema
from pipeline.schemas.base import fields_of, json_text

SCHEMA = "cartlab-results/1"


def results_dict(analysis: Analysis) -> dict[str, Any]:
    """Return the analysis as plain numbers, lists and strings; what could not be had is None."""
    position, drive = analysis.position_unit, analysis.input_unit
    fit, design = analysis.fit, analysis.feedback
    return {
        "schema": SCHEMA,
        "submission": fields_of(
            schema.Submitted,
            analysis,
            authors=[id_ for id_, _ in analysis.authors],
            units={"position": position, "input": drive},
        ),
        "parameters": [_parameter(row) for row in analysis.rows],
        "chain": fit and chain_entry(fit.chain, position=position, drive=drive),
        "state_space": fit and dict(zip("ABCD", fit.chain.state_space(), strict=True)),
        "fit": fit and fields_of(schema.Fit, fit, points=fit.n_points, starts=fit.n_starts),
        "log_decrements": [_log_decrement(decay) for decay in analysis.log_decrements],
        "step_gains": [fields_of(schema.StepGain, step) for step in analysis.step_gains],
        "frequency_response": [
            fields_of(schema.FrequencyResponse, one) for one in analysis.frequency_responses
        ],
        "checks": [fields_of(schema.Check, check) for check in analysis.checks],
        "feedback": design
        and fields_of(
            schema.Feedback,
            design,
            poles=[[pole.real, pole.imag] for pole in design.poles],
            margins=design.margins and vars(design.margins),
        ),
        "hardware": _hardware(analysis.hardware),
        "assumptions": [fields_of(schema.Assumption, one) for one in analysis.assumptions],
        "skipped": [fields_of(schema.Skipped, skip) for skip in analysis.skipped],
        "warnings": analysis.warnings,
        "provenance": provenance(analysis),
    }


def results_text(analysis: Analysis) -> str:
    """Return `results.json` as text, numbers at ten significant digits."""
    return json_text(results_dict(analysis))


def chain_entry(chain: Chain, *, position: str, drive: str) -> dict[str, Any]:
    """Return masses, dampings and stiffnesses with their units."""
    units = {
        "m": f"{drive} s^2/{position}",
        "c": f"{drive} s/{position}",
        "k": f"{drive}/{position}",
    }
    return {"m": chain.m, "c": chain.c, "k": chain.k, "units": units}


def provenance(analysis: Analysis) -> dict[str, Any]:
    """Return what made a file, and the SHA-256 of what it was made of."""
    return {"version": __version__, "files": dict(sorted(analysis.files.items()))}


def _parameter(row: ParameterRow) -> dict[str, Any]:
    estimates: dict[str, Any] = {}
    for key, estimate in (("initial", row.initial), ("final", row.final)):
        estimates[key] = estimate and estimate.value
        estimates[f"{key}_std"] = estimate and estimate.std
        estimates[f"{key}_from"] = estimate and estimate.source
    return fields_of(schema.Parameter, row, **estimates)


def _log_decrement(decay: LogDecrement) -> dict[str, Any]:
    friction = decay.friction and fields_of(schema.Friction, decay.friction)
    return fields_of(schema.LogDecrement, decay, friction=friction)


def _hardware(checks: tuple[HardwareCheck, ...]) -> list[dict[str, Any]]:
    """One entry a run and cart: the loop that ran, with the measured-input check inside it."""
    entries: dict[tuple[str, int], dict[str, Any]] = {}
    for check in sorted(checks, key=lambda check: check.loop):  # "closed" before "open"
        measured_input = fields_of(schema.MeasuredInput, check)
        key = (check.experiment, check.cart)
        if key in entries:
            entries[key]["measured_input"] = measured_input
            continue
        entries[key] = fields_of(
            schema.Hardware,
            check,
            settling_time_model=check.settling_model,
            settling_time_measured=check.settling_measured,
            measured_input=measured_input if check.loop == "open" else None,
        )
    return [entries[key] for key in sorted(entries)]
