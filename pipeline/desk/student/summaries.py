"""Summarise a group of the set-up in one line, and list what is missing in it."""

from collections.abc import Mapping
from dataclasses import replace

from pipeline.desk.student.form import Group
from pipeline.words.numbers import count


def summarise(group: Group) -> Group:
    """Return the group with its summary and with what is missing."""
    values = {field.path: field.value for field in group.fields}
    parts, missing = _SAY[group.key](group, values)
    return replace(group, summary=", ".join(filter(None, parts)), missing=missing)


_Said = tuple[list[str], str]


def _say_who(group: Group, values: Mapping[str, str]) -> _Said:
    people = [line.partition(",")[0].strip() for line in values["authors"].splitlines()]
    section = values["section"] and f"section {values['section']}"
    lacks = [word for word, path in (("a title", "title"), ("you", "authors")) if not values[path]]
    return [values["title"], section, *people], " and ".join(lacks)


def _say_bench(group: Group, values: Mapping[str, str]) -> _Said:
    carts = values["system.carts"]
    springs = next(field for field in group.fields if field.kind == "flags")
    names = [name for name, on in zip(springs.names, springs.on, strict=False) if on]
    asked = [field for field in group.fields if field.answers]
    parts = [
        f"{carts} cart{'' if carts == '1' else 's'}",
        f"springs {', '.join(names)}" if names else "no springs",
        values["system.position.unit"] or "count",
        values["system.input.unit"] or "V",
    ]
    return parts, count(len(asked), "answer") if asked else ""


def _say_design(group: Group, values: Mapping[str, str]) -> _Said:
    cart, step = values["design.cart"], values["design.reference"]
    parts = [cart and f"cart {cart}", step and f"step {step}", values["design.method"]]
    return parts if any(parts) else ["none"], ""


def _say_numbers(group: Group, values: Mapping[str, str]) -> _Said:
    typed = sum(1 for value in values.values() if value)
    if not typed:
        return ["none yet"], "your numbers"
    return [f"{typed} of {len(values)}"], ""


def _say_model(group: Group, values: Mapping[str, str]) -> _Said:
    return [field.label for field in group.fields if field.value] or ["none"], ""


_SAY = {
    "who": _say_who,
    "bench": _say_bench,
    "design": _say_design,
    "numbers": _say_numbers,
    "model": _say_model,
}
