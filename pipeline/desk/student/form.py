"""The form of `submission.toml`: its groups of fields, its authors, and the marks of doubts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import tomlkit
from tomlkit.items import AoT, Comment, Null

from pipeline.desk.toml_form import (
    Field,
    describe_field,
    find_value,
    read_value,
    set_item,
    write_field,
)
from pipeline.errors import SubmissionError
from pipeline.ingest.fill import UNSURE
from pipeline.names import parameter_names, read_name
from pipeline.setup import Units
from pipeline.submission import Submission
from pipeline.submission.edit import comment_text
from pipeline.submission.load import InvalidSubmission, list_experiments, spring_names
from pipeline.submission.models import MOST_CARTS
from pipeline.words.text import symbol_text

# The groups of the form: key, title, keys of the file. Before the last group comes a group for the
# parameters, whose names depend on the number of carts.
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
    groups = [*first, Group(key="numbers", title="Your numbers", fields=claims), last]
    return [replace(group, fields=_fill(group.fields, document)) for group in groups]


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
        place = next((i for i, f in enumerate(shown) if f"{path}.".startswith(f"{f.path}.")), None)
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
    return tuple(replace(field, value=read_value(document, field)) for field in named)


# --------------------------------------------------------------- from the form to the file


def write_fields(document: tomlkit.TOMLDocument, changed: Iterable[Field]) -> None:
    """Write typed values into a document; an empty field removes its key."""
    for field in changed:
        if field.path == "authors":
            _set_authors(document, field.value)
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


def _make_author(id_: str, name: str) -> Any:
    table = tomlkit.table()
    table.add("id", id_)
    if name:
        table.add("name", name)
    return table
