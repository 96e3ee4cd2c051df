"""The catalogue of effects, as text for a terminal and as data for JSON."""

import textwrap
from collections.abc import Sequence
from typing import Any

from pipeline.plant.effect import Effect, EffectParameter
from pipeline.words.math import to_tex, to_text
from pipeline.words.numbers import unit_text

POSITION, INPUT = "cm", "V"  # units of the presets; other benches may have other units

_WIDTH = 100
_WHERE = {
    "cart": "one cart (cart=1 …)",
    "spring": "one spring (spring=1 is at the near wall)",
    "input": "the input",
}


def catalogue_text(effects: Sequence[Effect]) -> str:
    """Return every effect with its place, law, parameters, fingerprint and deciding recording."""
    return "\n\n".join(_entry(effect) for effect in effects)


def catalogue_data(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Return the entries as data for JSON.

    A parameter that is usually left at its default has `detail` true.
    """
    return [
        {
            "effect": effect.key,
            "title": effect.title,
            "where": effect.place,
            "sentence": effect.sentence,
            "equation": to_tex(effect.formula),
            "parameters": [
                {
                    "name": p.name,
                    "symbol": p.symbol,
                    "unit": p.unit_text(position=POSITION, input=INPUT),
                    "signed": p.signed or p.side,
                    "detail": not p.reported,
                }
                for p in effect.parameters
            ],
            "fingerprint": effect.fingerprint,
            "deciding_experiment": effect.deciding_run,
            "reference": effect.reference,
            "equivalent": effect.equivalent or None,
        }
        for effect in effects
    ]


def parameter_text(parameter: EffectParameter) -> str:
    """Return a parameter as text: "force F [V]"; a pure number has no unit."""
    unit = unit_text(parameter.unit_text(position=POSITION, input=INPUT))
    name = f"{parameter.name} {parameter.symbol}"
    return f"{name} [{unit}]" if unit else name


def _entry(effect: Effect) -> str:
    details = [parameter_text(p) for p in effect.parameters if not p.reported]
    lines = [
        ("where", _WHERE[effect.place]),
        ("law", to_text(effect.formula)),
        ("parameters", ", ".join(parameter_text(p) for p in effect.parameters if p.reported)),
        ("contact details", ", ".join(details)),
        ("fingerprint", effect.fingerprint),
        ("decided by", effect.deciding_run),
        ("easily taken for", effect.equivalent),
        ("reference", effect.reference),
    ]
    text = [f"{effect.key}: {effect.sentence}"]
    text += [f"  {name}: {what}" for name, what in lines if what]
    return "\n".join(textwrap.fill(line, _WIDTH, subsequent_indent="    ") for line in text)
