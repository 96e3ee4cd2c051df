"""`gap.json`: what other programs read."""

from typing import Any

from pipeline.gap.types import FoundEffect, Gap, GapWindow, NamedValue, Rival
from pipeline.plant.chain import Chain

SCHEMA = "cartlab-gap/1"


def gap_json(gap: Gap, *, position_unit: str = "cm", input_unit: str = "V") -> dict[str, Any]:
    """Return the gap as plain JSON data; the units are those of the submission."""
    return {
        "schema": SCHEMA,
        "verdict": gap.verdict,
        "complete": gap.complete,
        "effects": [_effect(found) for found in gap.effects],
        "suspects": [_rival(rival) for rival in gap.suspects],
        "gap": {"baseline": gap.baseline, "final": gap.final, "noise_floor": gap.noise_floor},
        "repeatability": gap.repeatability,
        "by_record": [
            {
                "experiment": r.experiment,
                "cart": r.cart,
                "held_out": r.held_out,
                "baseline": r.baseline,
                "final": r.final,
                "noise_floor": r.noise_floor,
            }
            for r in gap.by_record
        ],
        "where": [_window(window) for window in gap.where],
        "left": [_window(window) for window in gap.left],
        "next_experiment": gap.next_experiment,
        "training": list(gap.training),
        "held_out": list(gap.held_out),
        "friction_spread": {str(cart): spread for cart, spread in gap.spread.items()},
        "units": {"position": position_unit, "input": input_unit},
        "linear": _chain(gap.linear.chain),
        "model": {
            "chain": _chain(gap.model.chain),
            "effects": [
                {
                    "effect": term.effect.key,
                    "where": term.where,
                    "parameters": term.effect.named(term.values),
                }
                for term in gap.model.terms
            ],
        },
        "notes": list(gap.notes),
    }


def _effect(found: FoundEffect) -> dict[str, Any]:
    return {
        "effect": found.effect.key,
        "where": found.where,
        "parameters": {name: _value(value) for name, value in found.parameters.items()},
        "details": {name: _value(value) for name, value in found.details.items()},
        "confidence": found.confidence,
        "nrmse_before": found.nrmse_before,
        "nrmse_after": found.nrmse_after,
        "rivals": [_rival(rival) for rival in found.rivals],
    }


def _window(window: GapWindow) -> dict[str, Any]:
    return {
        "experiment": window.experiment,
        "cart": window.cart,
        "from": window.start,
        "to": window.end,
        "what": window.what,
        "share": window.share,
    }


def _rival(rival: Rival) -> dict[str, Any]:
    return {
        "effect": rival.effect.key,
        "where": rival.where,
        "nrmse_after": rival.nrmse_after,
        "confidence": rival.confidence,
    }


def _value(value: NamedValue) -> dict[str, Any]:
    return {"value": value.value, "std": value.std, "unit": value.unit}


def _chain(chain: Chain) -> dict[str, list[float]]:
    return {"m": chain.m.tolist(), "c": chain.c.tolist(), "k": chain.k.tolist()}
