"""Read a rubric; every mistake in it is one line that names file, line, key and what is near."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline import submission
from pipeline.errors import ConfigError
from pipeline.grading import rubric
from pipeline.grading.rubric import InitialFinal, Parameters, Rubric, matching
from pipeline.resources import RUBRICS
from pipeline.submission.complaints import Location, dotted, explain, nearest, without_tag
from pipeline.submission.load import spring_names
from pipeline.submission.toml_file import parse_toml, read_text

_MAX_BYTES = 1_000_000
_CHECKS: dict[str, type[BaseModel]] = {
    check: model
    for model in get_args(get_args(rubric.Criterion)[0])
    for check in get_args(model.model_fields["check"].annotation)
}
_TABLES: dict[str, type[BaseModel]] = {
    "system": submission.System,
    "system.input": submission.Input,
    "system.position": submission.Position,
    "design": submission.Design,
    "required": rubric.Required,
    "required.experiments": rubric.RequiredRuns,
    "late": rubric.Late,
    **{f"criteria.{check}": model for check, model in _CHECKS.items()},
}
_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([A-Za-z0-9_.\"'-]+)\s*=")


def load_rubric(path: Path) -> Rubric:
    """Read and check a rubric: a file, or the name of one that is shipped.

    Raises
    ------
    ConfigError : one line for every mistake, with file, line, key and what was expected.
    """
    path = Path(path)
    if not path.exists() and path.suffix == "" and (RUBRICS / f"{path.name}.toml").is_file():
        path = RUBRICS / f"{path.name}.toml"
    if not path.exists():
        shipped = nearest(path.stem, sorted(p.stem for p in RUBRICS.glob("*.toml")))
        raise ConfigError(f"{path}: there is no such rubric{shipped}")
    return parse_rubric(rubric_source(path), where=path.name)


def rubric_source(path: Path) -> str:
    """Return the text of a rubric.

    Raises
    ------
    ConfigError : it cannot be read.
    """
    return read_text(path, where=path.name, limit=_MAX_BYTES, error=ConfigError)


def parse_rubric(text: str, *, where: str) -> Rubric:
    """Check the text of a rubric; `where` is what to call the file.

    Raises
    ------
    ConfigError : one line for every mistake, with file, line, key and what was expected.
    """
    document = parse_toml(text, where=where, error=ConfigError)
    problems = _validate(document)
    if isinstance(problems, Rubric):
        found, problems = problems, list(_contradictions(problems))
        if not problems:
            return found
        problems = [(at, f"{dotted(at, document)}: {what}") for at, what in problems]
    lines = [(_line_of(text, at), what) for at, what in problems]
    raise ConfigError("\n".join(f"{where} line {line}: {what}" for line, what in sorted(lines)))


def _validate(document: dict) -> Rubric | list[tuple[Location, str]]:
    try:
        return Rubric.model_validate(_tuples(document), strict=True)
    except ValidationError as error:
        plain, top = _tuples(document), tuple(Rubric.model_fields)
        return [_complaint(e, plain, top) for e in error.errors()]


def _complaint(
    error: ErrorDetails, document: dict, top_level: Sequence[str]
) -> tuple[Location, str]:
    """Return where a pydantic error is, without what is no key of the file, and what it says."""
    if error["type"] in ("union_tag_invalid", "union_tag_not_found"):
        at = [*error["loc"], "check"]
        found = error["input"].get("check", "") if isinstance(error["input"], dict) else ""
        known = nearest(found, tuple(_CHECKS))
        return at, f"{dotted(at, document)}: no such check {found!r}{known}"
    return (
        without_tag(error["loc"], document),
        explain(error, document, tables=_TABLES, top_level=top_level),
    )


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


# ------------------------------------------------- what the tables say about one another


def _contradictions(found: Rubric) -> Iterator[tuple[Location, str]]:
    n, names = found.system.carts, found.names
    if not found.criteria:
        yield ("criteria",), "there is none; add a [[criteria]] table for each"
    if len(found.system.springs) != n + 1:
        yield (
            ("system", "springs"),
            f"expected {n + 1} values ({', '.join(spring_names(n))}), "
            f"found {len(found.system.springs)}",
        )
    if found.design is not None and not 1 <= found.design.cart <= n:
        yield ("design", "cart"), f"there is no cart {found.design.cart}, the system has {n}"
    for i, runs in enumerate(found.required.experiments):
        for cart in runs.carts:
            if not 1 <= cart <= n:
                yield (
                    ("required", "experiments", i, "carts"),
                    f"there is no cart {cart}, the system has {n}",
                )
    for table in ("initial", "final"):
        for pattern in getattr(found.required, table):
            if not matching((pattern,), names):
                yield ("required", table), f"no parameter {pattern!r}{nearest(pattern, names)}"
    seen: set[str] = set()
    ids = [criterion.id for criterion in found.criteria]
    for i, criterion in enumerate(found.criteria):
        if criterion.id in seen:
            yield ("criteria", i, "id"), f"{criterion.id!r} is used before"
        for parent in criterion.requires:
            if parent not in seen:
                where = "comes later" if parent in ids else "is no criterion"
                known = "" if parent in ids else nearest(parent, ids)
                yield ("criteria", i, "requires"), f"{parent!r} {where}{known}"
        seen.add(criterion.id)
        if criterion.points != round(criterion.points, 2):
            yield ("criteria", i, "points"), f"{criterion.points:g}: points go to the hundredth"
        if isinstance(criterion, Parameters | InitialFinal):
            for pattern in criterion.parameters:
                if not matching((pattern,), names):
                    known = nearest(pattern, names)
                    yield ("criteria", i, "parameters"), f"no parameter {pattern!r}{known}"
        for full in (name for name in type(criterion).model_fields if "full" in name):
            none = full.replace("full", "none")
            if getattr(criterion, full) > getattr(criterion, none):
                yield ("criteria", i, full), f"is more than {none}"


# --------------------------------------------------------------------------- lines


def _line_of(text: str, at: Location) -> int:
    """Return the line of a key, or that of the nearest table around it."""
    best, line = 0, 1
    for number, path in _paths(text):
        depth = 0
        while depth < min(len(path), len(at)) and path[depth] == at[depth]:
            depth += 1
        if depth == len(path) and depth > best:
            best, line = depth, number
    return line


def _paths(text: str) -> Iterator[tuple[int, tuple[int | str, ...]]]:
    """Yield (line, path) of every table heading and every key that begins a line."""
    table: tuple[int | str, ...] = ()
    counts: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            keys = tuple(part.strip(" \"'") for part in header[2].split("."))
            table = keys
            if header[1] == "[[":
                counts[header[2]] = counts.get(header[2], -1) + 1
                table = (*keys, counts[header[2]])
            yield number, table
        elif key := _KEY.match(line):
            yield number, (*table, *(part.strip("\"'") for part in key[1].split(".")))
