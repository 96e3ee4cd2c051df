"""The form of `submission.toml`: its groups of fields, and doubts as questions with answers."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import tomlkit
from tomlkit.items import AoT, Comment, Null

from pipeline.desk.toml_form import (
    Answer,
    Field,
    describe_field,
    find_value,
    read_value,
    set_item,
    write_field,
)
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import is_known, position_units
from pipeline.ingest.fill import UNSURE, unit_doubt
from pipeline.names import parameter_names, read_name
from pipeline.plant.catalogue import CATALOGUE
from pipeline.setup import Units
from pipeline.submission import Submission
from pipeline.submission.edit import comment_text
from pipeline.submission.load import InvalidSubmission, list_experiments, spring_names
from pipeline.submission.models import MOST_CARTS
from pipeline.words.numbers import count, listing
from pipeline.words.text import symbol_text

# The groups of the form: key, title, keys of the file. Before the last group comes a group for the
# parameters, whose names depend on the number of carts. After it comes a group for effects.
_GROUPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("who", "Who and what", ("title", "section", "authors")),
    (
        "bench",
        "The bench",
        ("system.carts", "system.springs", "system.position.unit", "system.position.per_count",
         "system.input.unit", "system.input.sign", "system.input.per_count", "system.columns"),
    ),
    (
        "design",
        "The controller to design",
        ("design.cart", "design.reference", "design.overshoot_percent", "design.settling_time",
         "design.input_limit", "design.sample_time", "design.method"),
    ),
    (
        "model",
        "Your state model and controller",
        ("reported.state_space.A", "reported.state_space.B", "reported.feedback.gains",
         "reported.feedback.prefilter", "reported.feedback.overshoot_percent",
         "reported.feedback.settling_time"),
    ),
)  # fmt: skip
_OF_EXPERIMENT = ("kind", "carts", "frequency", "window", "note", "columns", "sample_rate")
_OF_LOOP = (
    "controlled_cart", "reference", "controller.type", "controller.gains", "controller.prefilter",
    "controller.kp", "controller.ki", "controller.kd", "controller.scale", "controller.cart",
)  # fmt: skip
_OF_CONTROLLER = {
    "state_feedback": ("gains", "prefilter"), "pid": ("kp", "ki", "kd", "scale", "cart"),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Why `submission.toml` is refused, as plain data.

    Attributes
    ----------
    text : the message.
    problems : the first problems, each with the path of its key; () if they have no keys.
    """

    text: str
    problems: Sequence[tuple[str, str]] = ()

    @classmethod
    def of(cls, error: SubmissionError) -> "Fault":
        """Return the fault that an error describes."""
        problems = error.problems if isinstance(error, InvalidSubmission) else ()
        located = tuple((".".join(map(str, at)), what) for at, what in problems)
        return cls(text=str(error), problems=located)


@dataclass(frozen=True, kw_only=True)
class Group:
    """Fields that belong together.

    Attributes
    ----------
    summary : the fields in one line.
    missing : fields that must still be filled in.
    """

    key: str
    title: str
    fields: tuple[Field, ...]
    summary: str = ""
    missing: str = ""

    @property
    def open(self) -> bool:
        """Whether the group is shown open, because something is missing or wrong in it."""
        return bool(self.missing) or any(field.wrong for field in self.fields)


def fill_form(document: Mapping[str, Any]) -> list[Group]:
    """Return the form of a submission, filled in from its file."""
    *first, last = [
        Group(
            key=key, title=title, fields=tuple(describe_field(path, Submission) for path in paths)
        )
        for key, title, paths in _GROUPS
    ]
    carts = count_carts(document)
    rigid = carts == 1 and find_value(document, "system.springs") == [False, False]
    units = Units(
        position=str(find_value(document, "system.position.unit") or "count"),
        input=str(find_value(document, "system.input.unit") or "V"),
    )
    claims = tuple(
        Field(
            path=f"reported.{which}.{name}",
            label=f"{symbol_text(name)} {which}",
            symbol=symbol_text(name),
            help=read_name(name).unit(units),
            kind="number",
        )
        for name in parameter_names(carts, rigid=rigid)
        for which in ("initial", "final")
    )
    groups = [
        *first,
        Group(key="numbers", title="Your numbers", fields=claims),
        last,
        Group(
            key="effects",
            title="Effects beyond the linear model",
            fields=tuple(_describe_effects(document, units)),
        ),
    ]
    return [replace(group, fields=_fill(group.fields, document)) for group in groups]


def _describe_effects(document: Mapping[str, Any], units: Units) -> Iterator[Field]:
    """Yield the fields of each effect in the file, and an empty choice for one more effect.

    A field of the kind `effect` chooses an effect by its title.
    """
    known = {effect.key: effect for effect in CATALOGUE}
    titles = ("", *(effect.title for effect in CATALOGUE))
    stated = find_value(document, "reported.effects")
    stated = stated if isinstance(stated, Mapping) else {}
    chosen = [known[key] for key in stated if key in known]
    for effect in chosen:
        table = f"reported.effects.{effect.key}"
        yield Field(path=table, label="Effect", kind="effect", choices=titles, value=effect.title)
        names = [] if effect.place == "input" else [(effect.place, "counted from the motor")]
        names += [
            (p.name, p.unit_text(position=units.position, input=units.input))
            for p in effect.parameters
            if p.reported
        ]
        for name, help in names:
            label = f"{effect.title}: {name.replace('_', ' ')}"
            yield Field(path=f"{table}.{name}", label=label, help=help, kind="number")
    yield Field(
        path="reported.effects",
        label="Another effect" if chosen else "Effect that you found",
        help="its place and size are asked for after you save",
        kind="effect",
        choices=titles,
    )


def fill_experiment(document: Mapping[str, Any], index: int) -> tuple[Field, ...]:
    """Return the fields of one experiment, filled in from its table.

    These are the fields for the experiment's kind and controller, and any further fields in the
    table.
    """
    table = f"experiments.{index}"
    kind = find_value(document, f"{table}.kind")
    chosen = find_value(document, f"{table}.controller.type")
    of_type = [f"controller.{key}" for key in _OF_CONTROLLER.get(str(chosen), ())]
    used = {*_OF_EXPERIMENT, *_OF_LOOP[:3], *of_type} - ({"frequency"} if kind != "sine" else set())
    first, rest = _OF_EXPERIMENT[:2], _OF_EXPERIMENT[2:]
    keys = (*first, *_OF_LOOP, *rest) if kind == "closed_loop" else _OF_EXPERIMENT
    fields = _fill([describe_field(f"{table}.{key}", Submission) for key in keys], document)
    return tuple(f for f, key in zip(fields, keys, strict=True) if key in used or f.value)


def sign_fields(document: Mapping[str, Any], signs: Mapping[str, int]) -> list[Field]:
    """Return a filled-in field for each input sign that its table does not state.

    Parameters
    ----------
    signs : sign of the input, by experiment.
    """
    return [
        replace(describe_field(path, Submission), value=f"{signs[table['id']]:d}")
        for index, table in enumerate(list_experiments(document))
        for path in [f"experiments.{index}.input.sign"]
        if table.get("id") in signs and find_value(document, path) is None
    ]


def is_of_loop(field: Field) -> bool:
    """Return whether a field of an experiment describes the controller that ran."""
    return field.path.split(".", 2)[2] in _OF_LOOP


def mark_errors(
    fields: Sequence[Field], changed: Sequence[Field], fault: Fault | None
) -> tuple[tuple[Field, ...], list[str]]:
    """Return the fields with their typed values and problems; list other problems separately."""
    now = {field.path: field for field in changed}
    shown = [now.get(field.path, field) for field in fields]
    left: list[str] = []
    if fault is not None and not fault.problems:
        left.append(fault.text)
    for path, what in fault.problems if fault else ():
        above = [i for i, f in enumerate(shown) if f"{path}.".startswith(f"{f.path}.")]
        place = max(above, key=lambda i: len(shown[i].path), default=None)
        if place is None:
            left.append(what)
        elif not shown[place].wrong:
            shown[place] = replace(shown[place], wrong=what.partition(": ")[2] or what)
    return tuple(shown), left


# --------------------------------------------------------------- from the file to the form


def count_carts(document: Mapping[str, Any]) -> int:
    """Return the number of carts in a file; 1 if the file states no valid number."""
    carts = find_value(document, "system.carts")
    return carts if isinstance(carts, int) and 1 <= carts <= MOST_CARTS else 1


def _fill(fields: Iterable[Field], document: Mapping[str, Any]) -> tuple[Field, ...]:
    springs = tuple(spring_names(count_carts(document)))
    named = (replace(f, names=springs if f.kind == "flags" else ()) for f in fields)
    return tuple(
        field if field.kind == "effect" else replace(field, value=read_value(document, field))
        for field in named
    )


# --------------------------------------------------------------- from the form to the file


def write_fields(document: tomlkit.TOMLDocument, changed: Iterable[Field]) -> None:
    """Write typed values into a document; an empty field removes its key."""
    changed = list(changed)
    replaced = tuple(f"{f.path}." for f in changed if f.kind == "effect" and f.path.count(".") > 1)
    for field in changed:
        if field.path == "authors":
            _set_authors(document, field.value)
        elif field.kind == "effect":
            _set_effect(document, field)
        elif field.path.startswith(replaced):
            continue  # of an effect that was replaced or removed
        else:
            # These two keys stay without a value, because they have comments in a new file.
            write_field(document, field, keep_empty=field.path in ("title", "section"))
            _settle(document, field.path)
        # After a change of the number of carts, all springs count as present again.
        if field.path == "system.carts":
            set_item(document, ["system", "springs"], None)


def _settle(document: tomlkit.TOMLDocument, path: str) -> None:
    """Remove the "doubtful" mark from a key of `[system]` that a person has just set."""
    table, key, *_ = [*path.split("."), ""]
    item: Any = document.get("system", {}).get(key) if table == "system" else None
    if item is not None and item.trivia.comment.startswith(f"# {UNSURE}"):
        item.trivia.comment_ws = item.trivia.comment = ""


def clear_marks(document: tomlkit.TOMLDocument, index: int, doubts: Iterable[str]) -> None:
    """Remove the comments that mark the given doubts from the table of an experiment."""
    texts = {f"# {_mark(doubt)}" for doubt in doubts}
    body: Any = document.get("experiments")
    if isinstance(body, AoT) and index < len(body):
        lines = body[index].value.body
        for place, (_, item) in enumerate(lines):
            if isinstance(item, Comment) and item.trivia.comment in texts:
                lines[place] = (None, Null())


def is_marked(doubt: str, marks: Sequence[str]) -> bool:
    """Return whether a table marks a doubt as unsure."""
    return _mark(doubt) in [UNSURE + mark for mark in marks]


def _mark(doubt: str) -> str:
    """Return the comment that marks a doubt, shortened to fit on a line of the file."""
    return comment_text(UNSURE + doubt)


def remove_experiment(document: tomlkit.TOMLDocument, index: int) -> None:
    """Remove the table of one experiment; its data file stays."""
    tables: Any = document["experiments"]
    if index < len(tables):
        del tables[index]


def _set_authors(document: tomlkit.TOMLDocument, text: str) -> None:
    """Write the authors, one per line of text; an existing table keeps what was not changed."""
    lines = [line.partition(",")[::2] for line in text.splitlines() if line.strip()]
    people = [(id_.strip(), name.strip()) for id_, name in lines]
    if not people:
        document.pop("authors", None)
        return
    tables: Any = document.get("authors")
    if tables is None:
        tables = tomlkit.aot()
        for person in people:
            tables.append(_make_author(*person))
        document.append("authors", tables)
        return
    for i, person in enumerate(people):
        if i >= len(tables):
            tables.append(_make_author(*person))
            continue
        for key, value in zip(("id", "name"), person, strict=True):
            if str(tables[i].get(key, "")) != value:
                set_item(tables[i], [key], tomlkit.item(value) if value else None)
    while len(tables) > len(people):
        del tables[len(tables) - 1]


def _set_effect(document: tomlkit.TOMLDocument, field: Field) -> None:
    """Write an empty table for the effect whose title was chosen, in place of the field's own."""
    parts = field.path.split(".")
    if parts[2:]:
        set_item(document, parts, None)
    if field.value:
        key = next((one.key for one in CATALOGUE if one.title == field.value), field.value)
        # On one line, because tomlkit can add such a table to any kind of table.
        set_item(document, ["reported", "effects", key], tomlkit.inline_table())


def _make_author(id_: str, name: str) -> Any:
    table = tomlkit.table()
    table.add("id", id_)
    if name:
        table.add("name", name)
    return table


# ----------------------------------------------------------------------- questions about the set-up

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
    parts, missing = _say(group, {field.path: field.value for field in group.fields})
    return replace(group, summary=", ".join(filter(None, parts)), missing=missing)


def _say(group: Group, values: Mapping[str, str]) -> tuple[list[str], str]:
    """Return what the summary of a group shows, and what is missing.

    Parameters
    ----------
    values : the values of its fields by their paths.
    """
    match group.key:
        case "who":
            people = [line.partition(",")[0].strip() for line in values["authors"].splitlines()]
            section = values["section"] and f"section {values['section']}"
            asked = (("a title", "title"), ("you", "authors"))
            lacks = " and ".join(word for word, path in asked if not values[path])
            return [values["title"], section, *people], lacks
        case "bench":
            springs = next(field for field in group.fields if field.kind == "flags")
            names = [name for name, on in zip(springs.names, springs.on, strict=False) if on]
            n_asked = sum(bool(field.answers) for field in group.fields)
            carts = values["system.carts"]
            parts = [
                f"{carts} cart{'' if carts == '1' else 's'}",
                f"springs {', '.join(names)}" if names else "no springs",
                values["system.position.unit"] or "count",
                values["system.input.unit"] or "V",
            ]
            return parts, count(n_asked, "answer") if n_asked else ""
        case "design":
            cart, step = values["design.cart"], values["design.reference"]
            parts = [cart and f"cart {cart}", step and f"step {step}", values["design.method"]]
            return parts if any(parts) else ["none"], ""
        case "numbers":
            typed = sum(bool(value) for value in values.values())
            return ([f"{typed} of {len(values)}"], "") if typed else (["none yet"], "your numbers")
        case "model":
            return [field.label for field in group.fields if field.value] or ["none"], ""
        case _:  # effects
            *stated, _ = group.fields
            lacks = "place and size" if any(not field.value for field in stated) else ""
            return [f.value for f in stated if f.kind == "effect"] or ["none"], lacks
