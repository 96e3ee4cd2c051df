"""`gap.json`: what other programs read."""

from typing import Any

from pipeline.gap.types import FoundEffect, Gap, GapWindow, NamedValue, Residual, Rival
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects.base import AugmentedChain
from pipeline.results_of_runs import Intervention
from pipeline.schemas import gap as schema
from pipeline.schemas.base import fields_of

SCHEMA = "cartlab-gap/1"


def gap_json(gap: Gap, *, position_unit: str = "cm", input_unit: str = "V") -> dict[str, Any]:
    """Return the gap as plain JSON data; the units are those of the submission."""
    return {
        "schema": SCHEMA,
        "verdict": gap.verdict,
        "complete": gap.complete,
        "effects": [_effect(found) for found in gap.effects],
        "suspects": [_rival(rival) for rival in gap.suspects],
        "gap": fields_of(schema.Errors, gap),
        "repeatability": gap.repeatability,
        "by_record": [fields_of(schema.RecordErrors, one) for one in gap.by_record],
        "free_run": [fields_of(schema.FreeRun, one) for one in gap.free_run],
        "where": [_window(window) for window in gap.where],
        "left": [_window(window) for window in gap.left],
        "residual": [_residual(one) for one in gap.residual],
        "next_experiment": gap.next_experiment,
        "next_recording": gap.proposal.recording if gap.proposal else None,
        "next_limits": gap.proposal.limits if gap.proposal else None,
        "separation": gap.proposal.separation if gap.proposal else None,
        "training": list(gap.training),
        "held_out": list(gap.held_out),
        "left_out": [fields_of(schema.LeftOut, one) for one in gap.left_out],
        "interventions": [_intervention(one) for one in gap.interventions],
        "friction_spread": {str(cart): spread for cart, spread in gap.spread.items()},
        "units": {"position": position_unit, "input": input_unit},
        "linear": _chain(gap.linear.chain),
        "model": _model(gap.model),
        "contenders": [{**_model(one.model), "weight": one.weight} for one in gap.contenders],
        "notes": list(gap.notes),
    }


def _model(model: AugmentedChain) -> dict[str, Any]:
    return {
        "chain": _chain(model.chain),
        "effects": [
            {
                "effect": term.effect.key,
                "where": term.where,
                "parameters": term.effect.named(term.values),
            }
            for term in model.terms
        ],
    }


def _effect(found: FoundEffect) -> dict[str, Any]:
    return fields_of(
        schema.Effect,
        found,
        effect=found.effect.key,
        parameters=_values(found.parameters),
        details=_values(found.details),
        rivals=[_rival(rival) for rival in found.rivals],
    )


def _values(values: dict[str, NamedValue]) -> dict[str, Any]:
    return {name: fields_of(schema.Value, value) for name, value in values.items()}


def _window(window: GapWindow) -> dict[str, Any]:
    return fields_of(schema.Window, window, from_=window.start, to=window.end)


def _intervention(one: Intervention) -> dict[str, Any]:
    return fields_of(schema.Intervention, one, from_=one.start, to=one.end)


def _residual(residual: Residual) -> dict[str, Any]:
    formula = residual.formula
    return {
        "cart": residual.cart,
        "unit": residual.unit,
        "against": [fields_of(schema.ForceAgainst, one) for one in residual.against],
        "formula": None
        if formula is None
        else {
            "text": formula.text,
            "terms": [fields_of(schema.FormulaTerm, term) for term in formula.terms],
            "explains": formula.explains,
            "in_catalogue": False,
        },
    }


def _rival(rival: Rival) -> dict[str, Any]:
    return fields_of(schema.Rival, rival, effect=rival.effect.key)


def _chain(chain: Chain) -> dict[str, list[float]]:
    return {"m": chain.m.tolist(), "c": chain.c.tolist(), "k": chain.k.tolist()}
