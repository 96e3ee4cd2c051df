"""Read a rubric; each mistake in it is reported in one line with file, line, key and suggestion."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from decimal import Decimal
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline.errors import ConfigError
from pipeline.grading import rubric
from pipeline.grading.rubric import (
    InitialFinal,
    Manual,
    Parameters,
    RequiredPieces,
    Rubric,
    StateModel,
    matching,
    source_of,
)
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

_MAX_BYTES = 1_000_000
_CHECKS: dict[str, type[BaseModel]] = {
    check: model
    for model in get_args(get_args(rubric.Criterion)[0])
    for check in get_args(model.model_fields["check"].annotation)
}
_OF_CRITERIA = tuple(rubric.DataQuality.model_fields)  # keys that every criterion has
# Valid values that replace wrong or missing ones, so that further mistakes can be found.
_HARMLESS: dict[str | int, Any] = {"version": 1, "points": 1.0, "id": "criterion", "kind": "step"}


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
    return read_text(path, where=path.name, limit=_MAX_BYTES, error=ConfigError)


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
    found = _validate(document)
    if not found.complaints and found.rubric is not None:
        return found.rubric
    problems = [(_line_of(text, one.at), one.what) for one in found.complaints]
    raise InvalidRubric(where, sorted(problems))


@dataclass(frozen=True, kw_only=True)
class _Complaint:
    """A problem, and its place in the document."""

    at: Location
    what: str


@dataclass(frozen=True, kw_only=True)
class _Validated:
    rubric: Rubric | None
    complaints: Sequence[_Complaint]


def _validate(document: dict) -> _Validated:
    """Check a document and report all problems, even those that an earlier one would hide."""
    complaints: list[_Complaint] = []
    criteria = document.get("criteria")
    if isinstance(criteria, tuple):
        tagged = [_with_check(own, i, document, complaints) for i, own in enumerate(criteria)]
        document = {**document, "criteria": tuple(tagged)}
    rubric, wrong = _try(document)
    complaints += [_complaint(error, document) for error in relevant_errors(wrong)]
    if wrong:
        rubric, _ = _try(_without(document, wrong))
    if rubric is not None:
        own = criteria if isinstance(criteria, tuple) else ()
        ids = [one.get("id") if isinstance(one, dict) else None for one in own]
        complaints += [
            _Complaint(at=at, what=f"{dotted(at, document)}: {what}")
            for at, what in _contradictions(rubric, ids)
        ]
    return _Validated(rubric=rubric, complaints=complaints)


def _try(document: dict) -> tuple[Rubric | None, list[ErrorDetails]]:
    try:
        return Rubric.model_validate(document, strict=True), []
    except ValidationError as error:
        return None, error.errors()


def _with_check(own: Any, i: int, document: dict, complaints: list[_Complaint]) -> Any:
    """Return a criterion with a valid check, so that its other keys can be checked too.

    If its check is unknown or missing, a problem is added to `complaints`, and the nearest valid
    check is used.
    """
    # A list, because the typed value may be unhashable.
    if not isinstance(own, dict) or own.get("check") in list(_CHECKS):
        return own
    at: Location = ("criteria", i, "check")
    meant = get_close_matches("check", [key for key in own if key not in _OF_CRITERIA], n=1)
    if "check" in own:
        typed = own["check"]
        what = f"no such check {quote(typed)}{nearest(typed, tuple(_CHECKS))}"
    elif meant:
        at, typed = ("criteria", i, meant[0]), own[meant[0]]
        what = "unknown key; did you mean 'check'?"
    else:
        typed, what = "", f"is required and missing{nearest('', tuple(_CHECKS))}"
    complaints.append(_Complaint(at=at, what=f"{dotted(at, document)}: {what}"))
    left = {key: value for key, value in own.items() if key not in meant}
    close = get_close_matches(str(typed), list(_CHECKS), n=1)
    if not close:  # no known check is similar, so only the common keys can be checked
        left = {key: value for key, value in left.items() if key in _OF_CRITERIA}
    return {**left, "check": close[0] if close else "data"}


def _complaint(error: ErrorDetails, document: dict) -> _Complaint:
    """Return an error of pydantic as a problem, with the keys of the file."""
    return _Complaint(
        at=without_tag(error["loc"], document),
        what=explain(error, document, root=Rubric),
    )


def _without(document: dict, wrong: Sequence[ErrorDetails]) -> dict:
    """Return a document in which wrong values are replaced by valid ones or removed."""
    left = deepcopy(document)
    for error in wrong:
        *way, key = without_tag(error["loc"], document)
        here: Any = left
        for part in way:
            try:
                here = here[part]
            except (KeyError, IndexError, TypeError):
                here = None
        if isinstance(here, dict) and key in _HARMLESS:
            here[key] = _HARMLESS[key]
        elif isinstance(here, dict):
            here.pop(key, None)
    return left


# ------------------------------------------------- contradictions between the tables


def _contradictions(found: Rubric, ids: Sequence[object]) -> Iterator[tuple[Location, str]]:
    """Yield place and problem of each contradiction between tables.

    Parameters
    ----------
    ids : the ids of the criteria as typed.
    """
    n, names = found.system.carts, found.names
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
    by_person = {criterion.id for criterion in found.criteria if isinstance(criterion, Manual)}
    seen: set[str] = set()
    known_ids = [id_ for id_ in ids if isinstance(id_, str)]
    for i, (id_, criterion) in enumerate(zip(ids, found.criteria, strict=True)):
        if isinstance(id_, str) and id_ in seen:
            yield ("criteria", i, "id"), f"{id_!r} was used before"
        if isinstance(criterion, Manual) and criterion.requires:
            yield ("criteria", i, "requires"), "has no effect, because a person grades this"
        for parent in criterion.requires:
            if parent in by_person:
                what = f"{parent!r} is graded by a person, later than this criterion"
                yield ("criteria", i, "requires"), what
            if parent not in seen:
                where = "comes later" if parent in ids else "is not a criterion"
                known = "" if parent in ids else nearest(parent, known_ids)
                yield ("criteria", i, "requires"), f"{parent!r} {where}{known}"
        if isinstance(id_, str):
            seen.add(id_)
        points = criterion.points
        if points != round(points, 2):
            yield ("criteria", i, "points"), f"{points:g}: points have at most two decimals"
        elif Decimal(str(points)) % Decimal(str(found.step)):
            message = f"{points:g} is not a multiple of step = {found.step:g}"
            yield ("criteria", i, "points"), message
        states = [f"{x}{cart}" for cart in range(1, n + 1) for x in "xv"]
        named = criterion.states if isinstance(criterion, StateModel) else ()
        if named and sorted(named) != sorted(states):
            yield ("criteria", i, "states"), f"needs each of {', '.join(states)} once"
        if isinstance(criterion, Parameters) and source_of(criterion) == "own":
            derived = derived_names(n)
            for name in matching(criterion.parameters, names):
                if name not in derived:
                    known = f", as {', '.join(derived)} do" if derived else ""
                    what = (
                        f'{name} does not follow from the other numbers{known}: remove from = "own"'
                    )
                    yield ("criteria", i, "parameters"), what
                    break
        if isinstance(criterion, Parameters | InitialFinal):
            for pattern in criterion.parameters:
                if not matching((pattern,), names):
                    known = _nearest(pattern, names)
                    yield ("criteria", i, "parameters"), f"no parameter {pattern!r}{known}"
        if isinstance(criterion, RequiredPieces):
            asked = list(dict.fromkeys(runs.kind for runs in found.required.experiments))
            for kind in (kind for kind in criterion.experiments if kind not in asked):
                what = f"no [[required.experiments]] has kind {kind!r}{nearest(kind, asked)}"
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
