"""The set-up on a page: its doubts as questions with answers, and each group in one line."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from pipeline.desk.student.form import Group
from pipeline.desk.toml_form import Answer, Field
from pipeline.ingest.columns import is_known, position_units
from pipeline.ingest.fill import unit_doubt
from pipeline.words.numbers import count, listing

NO_QUESTIONS: Mapping[str, Any] = {"system": {}, "springs": (), "experiments": ()}


def ask_setup_questions(
    fields: Iterable[Field],
    *,
    fractions: Sequence[str],
    doubts: Mapping[str, Any],
    findings: Mapping[str, Any],
) -> tuple[Field, ...]:
    """Return the fields of the set-up; each doubtful one has a question and possible answers.

    Parameters
    ----------
    fractions : files whose positions are not whole numbers.
    doubts : what `submission.toml` marks as unsure; see `folder_tasks.folder_state`.
    findings : assumptions and contradictions of the current report.
    """
    return tuple(
        replace(field, asked=asked, answers=answers) if asked else field
        for field in fields
        for asked, answers in [_ask(field, fractions=fractions, doubts=doubts, findings=findings)]
    )


def _ask(
    field: Field,
    *,
    fractions: Sequence[str],
    doubts: Mapping[str, Any],
    findings: Mapping[str, Any],
) -> tuple[str, tuple[Answer, ...]]:
    if field.path == "system.position.unit" and (
        doubt := unit_doubt(field.value or "count", fractions=fractions)
    ):
        known = is_known(field.value or "count", position_units())
        return doubt, (Answer(label="Use cm", value="cm"),) if known else ()
    if field.path == "system.springs" and "springs" in doubts["system"]:
        return doubts["system"]["springs"], _list_springs(field, doubts["springs"])
    wrong = [one for one in findings["contradicted"] if one["key"] == field.path]
    if wrong and (answers := _contradict(field, wrong)):
        return "; ".join(_name(one, one["why"]) for one in wrong), answers
    assumptions = [one for one in findings["assumed"] if one["key"] == field.path]
    if any(one["support"] == "open" for one in assumptions) and (
        answers := _confirm(field, assumptions)
    ):
        assumed = listing(list(dict.fromkeys(_name(one, one["taken"]) for one in assumptions)))
        return f"not stated, and the data do not show it; assumed: {assumed}", answers
    return "", ()


def _name(one: Mapping[str, str], value: str) -> str:
    return f"{one['about']}: {value}" if one["about"] else value


def _list_springs(field: Field, unknown: Sequence[int]) -> tuple[Answer, ...]:
    """Return an answer for every likely set of the springs that the data do not determine.

    Parameters
    ----------
    unknown : numbers of the springs that the data do not determine, from 1.
    """
    if not unknown:
        return (Answer(label="The ticks are right", value=field.value),)
    places = [number - 1 for number in unknown]
    if len(places) == 1:
        (place,) = places
        return (
            Answer(label="Spring present", value=_with(field, {place: True})),
            Answer(label="No spring here", value=_with(field, {place: False})),
        )
    only = [
        Answer(
            label=f"Only {field.names[place]}",
            value=_with(field, {other: other == place for other in places}),
        )
        for place in places
    ]
    return (
        Answer(label="All of them", value=_with(field, dict.fromkeys(places, True))),
        *only,
        Answer(label="None of them", value=_with(field, dict.fromkeys(places, False))),
    )


def _contradict(field: Field, wrong: Sequence[Mapping[str, Any]]) -> tuple[Answer, ...]:
    """Return answers that change what the data contradict."""
    if field.path == "system.springs":
        gone = {field.names.index(one["about"]): False for one in wrong if one["value"] is True
                and one["about"] in field.names}  # fmt: skip
        return (Answer(label="No spring here", value=_with(field, gone)),) if gone else ()
    if field.path == "system.input.sign":
        return (_turn(wrong[0]["value"]),)
    return ()


def _confirm(field: Field, taken: Sequence[Mapping[str, Any]]) -> tuple[Answer, ...]:
    """Return answers that state what the report assumed."""
    if field.path == "system.springs":
        return (Answer(label="All are present", value=field.value),)
    if field.path == "system.input.sign":
        sign = taken[0]["value"]
        return Answer(label="This is right", value=f"{sign:.0f}"), _turn(sign)
    if field.path in ("system.position.unit", "system.input.unit"):
        unit = taken[0]["taken"]
        return (Answer(label=f"It is {unit}", value=unit),)
    return ()


def _turn(sign: float) -> Answer:
    return Answer(label="Reverse the sign", value=f"{-sign:.0f}")


def _with(field: Field, flags: Mapping[int, bool]) -> str:
    """Return the value of a field of flags, with some flags changed."""
    every = [flags.get(place, on) for place, on in enumerate(field.on)]
    return " ".join("true" if on else "false" for on in every)


def ask_held(field: Field, hardly: Sequence[int], carts: Sequence[int]) -> Field:
    """Return the field of free carts with the question whether some carts were held.

    Parameters
    ----------
    hardly : the carts that hardly move.
    carts : all carts that count as free.
    """
    others = [cart for cart in carts if cart not in hardly]
    which = listing([str(cart) for cart in hardly])
    number = "s" if len(hardly) > 1 else ""
    return replace(
        field,
        asked=f"cart{number} {which} hardly move{'' if number else 's'}",
        answers=(
            Answer(label="It was held", value=", ".join(map(str, others))),
            Answer(label="It was free", value=", ".join(map(str, carts))),
        ),
    )


# ------------------------------------------------------------------------- a group in one line


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
