"""Read a rubric; each mistake in it is reported in one line with file, line, key and suggestion."""

from collections.abc import Iterator, Sequence
from decimal import Decimal
from difflib import get_close_matches
from pathlib import Path
from typing import get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.rubric import Rubric, matching, source_of
from pipeline.names import derived_names, read_name
from pipeline.resources import RUBRICS
from pipeline.submission.load import spring_names
from pipeline.submission.toml import (
    Location,
    TomlSlip,
    at_line,
    dotted,
    explain,
    key_lines,
    nearest,
    quote,
    read_text,
    read_toml,
    relevant_errors,
    without_tag,
)

_CHECKS: tuple[str, ...] = tuple(
    check
    for model in get_args(get_args(asked.Criterion)[0])
    for check in get_args(model.model_fields["check"].annotation)
)
_OF_CRITERIA = tuple(asked.DataQuality.model_fields)  # keys that every criterion has


def load_rubric(path: Path) -> Rubric:
    """Return the rubric in a file, or a shipped one by its name.

    Raises
    ------
    ConfigError : the rubric has mistakes; the message has a line for each.
    """
    path = find_rubric(path)
    return parse_rubric(rubric_source(path), where=path.name)


def find_rubric(path: Path) -> Path:
    """Return the path of a rubric, given a path or the name of a shipped rubric.

    Raises
    ------
    ConfigError : there is no such rubric.
    """
    path = Path(path)
    if not path.exists() and path.suffix == "" and (RUBRICS / f"{path.name}.toml").is_file():
        path = RUBRICS / f"{path.name}.toml"
    if not path.exists():
        shipped = nearest(path.stem, sorted(p.stem for p in RUBRICS.glob("*.toml")))
        raise ConfigError(f"{path}: there is no such rubric{shipped}")
    return path


def shipped_rubric(carts: int) -> Rubric | None:
    """Return the shipped rubric for a number of carts, if there is one."""
    path = RUBRICS / f"throne-{carts}dof.toml"
    return load_rubric(path) if path.is_file() else None


def rubric_source(path: Path) -> str:
    """Return the text of a rubric."""
    return read_text(path, where=path.name, limit=1_000_000, error=ConfigError)


class InvalidRubric(ConfigError):
    """A rubric has mistakes.

    Attributes
    ----------
    problems : pairs of line number and problem, in the order of the file; line 0 means the whole
        file.
    """

    def __init__(self, where: str, problems: Sequence[tuple[int, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(at_line(where, line, what) for line, what in self.problems))


def parse_rubric(text: str, *, where: str) -> Rubric:
    """Return the rubric in a text.

    Parameters
    ----------
    where : name of the file in messages.

    Raises
    ------
    InvalidRubric : the rubric has mistakes. If it is not TOML, the first is listed; else all are.
    """
    try:
        document = read_toml(text, root=Rubric)
    except TomlSlip as slip:
        raise InvalidRubric(where, [(slip.line, str(slip))]) from None
    try:
        rubric = Rubric.model_validate(document, strict=True)
    except ValidationError as error:
        wrong = relevant_errors(error.errors())
        problems = [
            _unknown_check(one, document)
            if one["type"].startswith("union_tag") and "criteria" in one["loc"]
            else (without_tag(one["loc"], document), explain(one, document, root=Rubric))
            for one in wrong
        ]
    else:
        problems = [(at, f"{dotted(at, document)}: {what}") for at, what in _contradictions(rubric)]
        if not problems:
            return rubric
    raise InvalidRubric(where, sorted((_line_of(text, at), what) for at, what in problems))


def _unknown_check(error: ErrorDetails, document: dict) -> tuple[Location, str]:
    """Return place and problem of a criterion whose check is missing or unknown."""
    own, at = error["input"], (*error["loc"], "check")
    near = get_close_matches("check", [key for key in own if key not in _OF_CRITERIA], n=1)
    if "check" in own:
        what = f"no such check {quote(own['check'])}{nearest(own['check'], _CHECKS)}"
    elif near:
        at, what = (*error["loc"], near[0]), "unknown key; did you mean 'check'?"
    else:
        what = f"is required and missing{nearest('', _CHECKS)}"
    return at, f"{dotted(at, document)}: {what}"


# ------------------------------------------------- contradictions between the tables


def _contradictions(found: Rubric) -> Iterator[tuple[Location, str]]:
    """Yield place and problem of each contradiction between tables."""
    n, names = found.system.carts, found.names
    ids = [criterion.id for criterion in found.criteria]
    if not found.criteria:
        yield ("criteria",), "missing; add a [[criteria]] table for each criterion"
    if found.step != round(found.step, 2):
        yield ("step",), f"{found.step:g}: points have at most two decimals"
    if found.late.percent_per_day > 100:  # not in the model, which reads older gradebooks too
        percent = f"{found.late.percent_per_day:g}"
        yield ("late", "percent_per_day"), f"expected a number from 0 to 100, found {percent}"
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
                yield ("required", table), f"no parameter {pattern!r}{_nearest(pattern, names)}"
    by_person = {
        criterion.id for criterion in found.criteria if isinstance(criterion, asked.Manual)
    }
    seen: set[str] = set()
    for i, criterion in enumerate(found.criteria):
        if criterion.id in seen:
            yield ("criteria", i, "id"), f"{criterion.id!r} was used before"
        if isinstance(criterion, asked.Manual) and criterion.requires:
            yield ("criteria", i, "requires"), "has no effect, because a person grades this"
        for parent in criterion.requires:
            if parent in by_person:
                what = f"{parent!r} is graded by a person, later than this criterion"
                yield ("criteria", i, "requires"), what
            if parent not in seen:
                where = "comes later" if parent in ids else "is not a criterion"
                known = "" if parent in ids else nearest(parent, ids)
                yield ("criteria", i, "requires"), f"{parent!r} {where}{known}"
        seen.add(criterion.id)
        points = criterion.points
        if points != round(points, 2):
            yield ("criteria", i, "points"), f"{points:g}: points have at most two decimals"
        elif Decimal(str(points)) % Decimal(str(found.step)):
            message = f"{points:g} is not a multiple of step = {found.step:g}"
            yield ("criteria", i, "points"), message
        states = [f"{x}{cart}" for cart in range(1, n + 1) for x in "xv"]
        named = criterion.states if isinstance(criterion, asked.StateModel) else ()
        if named and sorted(named) != sorted(states):
            yield ("criteria", i, "states"), f"needs each of {', '.join(states)} once"
        if isinstance(criterion, asked.Parameters) and source_of(criterion) == "own":
            derived = derived_names(n)
            given = [n for n in matching(criterion.parameters, names) if n not in derived]
            if given:
                known = f", as {', '.join(derived)} do" if derived else ""
                what = (
                    f'{given[0]} does not follow from the other numbers{known}: remove from = "own"'
                )
                yield ("criteria", i, "parameters"), what
        if isinstance(criterion, asked.Parameters | asked.InitialFinal):
            for pattern in criterion.parameters:
                if not matching((pattern,), names):
                    known = _nearest(pattern, names)
                    yield ("criteria", i, "parameters"), f"no parameter {pattern!r}{known}"
        if isinstance(criterion, asked.RequiredPieces):
            kinds = list(dict.fromkeys(runs.kind for runs in found.required.experiments))
            for kind in (kind for kind in criterion.experiments if kind not in kinds):
                what = f"no [[required.experiments]] has kind {kind!r}{nearest(kind, kinds)}"
                yield ("criteria", i, "experiments"), what
        for full in (name for name in type(criterion).model_fields if "full" in name):
            none = full.replace("full", "none")
            if getattr(criterion, full) > getattr(criterion, none):
                yield ("criteria", i, full), f"is more than {none}"


# --------------------------------------------------------------------------- lines


def _nearest(pattern: str, names: Sequence[str]) -> str:
    """Return a suggestion for a name that matches no parameter: a pattern, if one was typed."""
    patterns = [f"{read.symbol}_*" for read in map(read_name, names) if read.suffix]
    return nearest(pattern, list(dict.fromkeys(patterns)) if "*" in pattern else names)


def _line_of(text: str, at: Location) -> int:
    """Return the line of a key, or the line of the nearest table that contains it."""
    best, line = 0, 1
    for number, path in key_lines(text):
        depth = 0
        while depth < min(len(path), len(at)) and path[depth] == at[depth]:
            depth += 1
        if depth == len(path) and depth > best:
            best, line = depth, number
    return line
