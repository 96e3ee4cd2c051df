"""Read `submission.toml` into a validated `Submission`; every fault gives one line."""

import errno
import re
import stat
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipeline.errors import SubmissionError, is_file_fault
from pipeline.names import parameter_names
from pipeline.submission.models import (
    Experiment,
    Reported,
    StateFeedbackController,
    Submission,
    Unread,
    is_named,
)
from pipeline.submission.toml import (
    MOST_LISTED,
    MOST_SPOILT,
    Location,
    Statement,
    TomlSlip,
    at_line,
    backslash_words,
    dotted,
    explain,
    list_faults,
    list_keys,
    mend_number,
    nearest,
    parse_toml,
    plain_values,
    quote,
    read_apart,
    read_text,
    relevant_errors,
    without_tag,
)

NAME = "submission.toml"
MAX_TOML_BYTES = 1_000_000  # a tenth is enough for the experiments of a full class section
MAX_NOTES_BYTES = 1_000_000
MAX_DATA_BYTES = 100_000_000  # over half an hour at 1 kHz
COMMENT = re.compile(r"<!--.*?(?:-->|\Z)", re.DOTALL)  # an unclosed comment reaches to the end


def load_submission(path: Path) -> Submission:
    """Read and check a submission, given as the folder or as its `submission.toml`.

    If an experiment has no `carts`, all carts are filled in. `file` is normalised to forward
    slashes. Numbers under `[reported]` keep their digits as typed. A number or table there that
    cannot be read is left out, and listed in `unread`.

    Raises
    ------
    SubmissionError : the submission is invalid elsewhere. Each line names the file and the key, and
        says what was expected and found.
    """
    path = Path(path)
    toml = path if path.is_file() or path.suffix == ".toml" else path / NAME
    folder = toml.parent
    where = str(path) if toml == path else f"{folder.resolve().name}/{NAME}"
    if not folder.is_dir():
        raise SubmissionError(f"{quote(str(path))}: no such folder")
    if toml != path and not toml.exists() and not toml.is_symlink():
        hint = _near_file(folder, NAME, ()) or "; cartlab fill writes one for the files in data/"
        raise SubmissionError(f"{quote(str(path))}: contains no {NAME}{hint}")
    if (problem := file_problem(folder, toml.name)) is not None:
        raise SubmissionError(f"{where}: {problem}")
    text = read_text(toml, where=where, limit=MAX_TOML_BYTES, error=SubmissionError)
    return parse_readable(text, folder=folder, where=where)


def parse_readable(text: str, *, folder: Path, where: str = NAME) -> Submission:
    """Check the text of a `submission.toml`, and leave out what cannot be read of `[reported]`.

    Raises
    ------
    SubmissionError : the submission is invalid elsewhere.
    """
    try:
        return parse_submission(text, folder=folder, where=where)
    except SubmissionError:
        return _without_unread(text, folder=folder, where=where)


class InvalidSubmission(SubmissionError):
    """The content of `submission.toml` is invalid.

    Attributes
    ----------
    problems : the first problems found, each with its place; the error's text has a line for each.
    """

    def __init__(self, where: str, problems: Sequence[tuple[Location, str]]) -> None:
        self.problems = tuple(problems)[:MOST_LISTED]
        super().__init__(list_faults(where, [what for _, what in self.problems]))


def parse_submission(text: str, *, folder: Path, where: str = NAME) -> Submission:
    """Check the text of a `submission.toml` for a folder.

    Parameters
    ----------
    where : the name of the file in messages.

    Raises
    ------
    SubmissionError : the text is not TOML.
    InvalidSubmission : the content is invalid; the message lists the first problems.
    """
    # Decimals are kept, so that no typed digit is lost.
    document = parse_toml(text, where=where, error=SubmissionError, as_typed=True, root=Submission)
    return _check(document, folder=folder, where=where)


def _without_unread(text: str, *, folder: Path, where: str) -> Submission:
    """Return a submission without the parts of `[reported]` that cannot be read.

    Raises
    ------
    SubmissionError : something else cannot be read.
    """
    try:
        document, statements = read_apart(text, "reported", root=Submission)
    except TomlSlip as slip:
        raise SubmissionError(at_line(where, slip.line, str(slip))) from None
    typed = {one.at: one for one in reversed(statements)}  # the first of each key
    unread: dict[Location, Unread] = {}

    def leave_out(at: Location, line: int, what: str) -> None:
        """Leave out a number or table of `[reported]`; other tables stay."""
        part = tuple(key for key in at[:3] if isinstance(key, str))  # not the number of a [[table]]
        unread.setdefault(part, Unread(at=part, message=at_line(NAME, line, what)))
        if len(unread) > MOST_SPOILT:
            raise SubmissionError(f"{where}: [reported] has more than {MOST_SPOILT} mistakes")
        *above, key = part
        table: Any = document
        for name in above:
            table = table.get(name) if isinstance(table, dict) else None
        if isinstance(table, dict) and (above or not isinstance(table.get(key), dict)):
            table.pop(key, None)

    for one in statements:
        if one.fault:
            leave_out(one.at, *one.fault)
    while True:  # a round finds the first problems of one kind, and leaves at least one part out
        try:
            submission = _check(document, folder=folder, where=where)
            return submission.model_copy(update={"unread": tuple(unread.values())})
        except InvalidSubmission as wrong:
            before = len(unread)
            if any(tuple(at[:1]) != ("reported",) for at, _ in wrong.problems):
                raise
            for at, what in wrong.problems:
                above = (typed.get((*at[:n],)) for n in range(min(len(at), 3), 0, -1))
                line = next((one.line for one in above if one), 0)
                leave_out(at, line, what + _write(typed.get((*at,))))
            if len(unread) == before:
                raise


def _write(typed: Statement | None) -> str:
    """Return "; write …" for a number that was typed as text; "" for anything else."""
    mended = mend_number(typed.text) if typed and re.search("[\"']", typed.text) else ""
    return f"; write {mended}" if mended else ""


def _check(document: dict[str, Any], *, folder: Path, where: str) -> Submission:
    submission = _validate(document, where=where)
    _refuse(_problems(submission, folder), document, where=where)
    everyone = tuple(range(1, submission.system.carts + 1))
    experiments = tuple(
        experiment.model_copy(
            update={
                "carts": tuple(sorted(experiment.carts)) or everyone,
                "file": posix(experiment.file),
            }
        )
        for experiment in submission.experiments
    )
    return submission.model_copy(
        update={"experiments": experiments, "folder": folder, "discussion": load_notes(folder)}
    )


def _refuse(problems: Iterable[tuple[Location, str]], document: dict, *, where: str) -> None:
    """Raise the problems of a document, if there are any, with their places."""
    if worded := [(at, f"{dotted(at, document)}: {what}") for at, what in problems]:
        raise InvalidSubmission(where, worded)


def with_reported(submission: Submission, reported: Mapping[str, Any]) -> Submission:
    """Return the submission with new numbers under `[reported]`, checked as if read from a file.

    Parameters
    ----------
    reported : the tables of `[reported]`. A number given as text, such as "0.10", keeps its digits.

    Raises
    ------
    InvalidSubmission : the numbers are invalid; the message lists every problem.
    """
    system = {"carts": submission.system.carts}
    document = {"version": 1, "system": system, "reported": _as_typed(reported)}
    changed = submission.model_copy(
        update={"reported": _validate(document, where="numbers").reported}
    )
    _refuse(_reported_problems(changed), document, where="numbers")
    return changed


def _as_typed(value: object) -> object:
    """Return numbers and number texts as decimals, and arrays as lists."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _as_typed(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_typed(item) for item in value]
    if isinstance(value, float | str):
        with suppress(InvalidOperation):
            return Decimal(str(value))
    return value


# ------------------------------------------------------------- from a document to a model


def _validate(document: dict, *, where: str) -> Submission:
    refused: list[tuple[Location, str]] = []
    try:
        plain = plain_values(document, refused=refused, exact="reported")
    except RecursionError:
        raise SubmissionError(f"{where}: lists or tables nest too deeply") from None
    _refuse(refused, document, where=where)
    keys = list_keys(Submission)  # without the fields that no file may state
    stated = [key for key in document if key in Submission.model_fields and key not in keys]
    _refuse([((key,), f"unknown key{nearest(key, keys)}") for key in stated], document, where=where)
    try:
        return Submission.model_validate(plain, strict=True)
    except ValidationError as error:
        first = relevant_errors(error.errors())[:MOST_LISTED]
        worded = [(without_tag(e["loc"], plain), explain(e, plain, root=Submission)) for e in first]
        raise InvalidSubmission(where, worded) from None


def load_notes(folder: Path) -> str | None:
    """Return the text of `notes.md`, shortened and without comments; None if nothing is left."""
    path, where = folder / "notes.md", f"{folder.resolve().name}/notes.md"
    if not path.exists() and not path.is_symlink():
        return None
    if (problem := file_problem(folder, "notes.md")) is not None:
        raise SubmissionError(f"{where}: {problem}")
    typed = read_text(path, where=where, limit=MAX_NOTES_BYTES, error=SubmissionError)
    text = COMMENT.sub("", typed)
    most = 30_000  # characters; about fifteen pages
    if len(text) > most:
        shown = text[: text.rfind("\n", 0, most) + 1] or text[:most]
        length = f"{len(shown):,} of {len(text):,} characters"
        text = f"{shown}\n\n(notes.md is longer: {length} are shown.)\n"
    return text if text.strip() else None


# --------------------------------------------------------- consistency of tables


def _problems(submission: Submission, folder: Path) -> Iterator[tuple[Location, str]]:
    """Yield (location, problem) for problems that involve several values."""
    n, springs = submission.system.carts, submission.system.springs
    yield from _another_count(submission)
    if len(springs) != n + 1:
        yield (
            ("system", "springs"),
            f"expected {n + 1} values ({', '.join(spring_names(n))}), found {len(springs)}",
        )
    for key, what in _columns(submission.system.columns, n):
        yield ("system", *key), what
    if submission.design is not None:
        yield from _in_range(("design", "cart"), submission.design.cart, n)
    seen: dict[str, int] = {}
    for i, experiment in enumerate(submission.experiments):
        if experiment.id in seen:
            first = seen[experiment.id] + 1
            yield ("experiments", i, "id"), f"used before, by experiments[{first}]"
        seen.setdefault(experiment.id, i)
        for key, what in _experiment_problems(experiment, n, folder):
            yield ("experiments", i, *key), what
    for i, pattern in enumerate(submission.leave_out):
        if not any(is_named(name, pattern) for name in seen):
            yield (
                ("leave_out", i),
                f"{quote(pattern)} names no experiment{nearest(pattern, [*seen])}",
            )
    if submission.experiments and not submission.used:
        yield ("leave_out",), "leaves out every experiment"
    yield from _reported_problems(submission)


def _another_count(submission: Submission) -> Iterator[tuple[Location, str]]:
    """Yield a problem if `carts` is contradicted by at least two statements that agree."""
    reported = submission.reported or Reported()
    controllers = {e.id: e.controller for e in submission.experiments}
    lengths = {
        f"the gains of {name}": len(law.gains)
        for name, law in controllers.items()
        if isinstance(law, StateFeedbackController)
    }
    lengths["the reported gains"] = len(reported.feedback.gains) if reported.feedback else 0
    lengths["the reported A"] = len(reported.state_space.A) if reported.state_space else 0
    given = {what: length for what, length in lengths.items() if length}
    if len(given) < 2 or len(set(given.values())) > 1:
        return
    length, n = next(iter(given.values())), submission.system.carts
    if length != 2 * n and length % 2 == 0:
        yield ("system", "carts"), f"carts = {n}, but {' and '.join(given)} are for {length // 2}"


def spring_names(carts: int) -> list[str]:
    """Return "wall-1", "1-2", …: the names of the springs from one wall to the other."""
    return ["wall-1", *(f"{i}-{i + 1}" for i in range(1, carts)), f"{carts}-wall"]


def _in_range(at: Location, cart: int, n: int) -> Iterator[tuple[Location, str]]:
    if not 1 <= cart <= n:
        carts = "only cart 1" if n == 1 else f"carts 1 to {n}"
        yield at, f"there is no cart {cart}, the system has {carts}"


def _experiment_problems(
    experiment: Experiment, n: int, folder: Path
) -> Iterator[tuple[Location, str]]:
    if not experiment.id.strip() or not experiment.id.isprintable() or len(experiment.id) > 100:
        yield ("id",), "expected 1 to 100 printable characters"
    if (problem := path_problem(folder, experiment.file)) is not None:
        yield ("file",), problem
    for j, cart in enumerate(experiment.carts):
        yield from _in_range(("carts", j), cart, n)
    if len(set(experiment.carts)) < len(experiment.carts):
        yield ("carts",), f"a cart is named twice: {quote(experiment.carts)}"
    if experiment.window is not None and not experiment.window[0] < experiment.window[1]:
        start, end = experiment.window
        yield ("window",), f"expected [start, end] with start before end, found [{start}, {end}]"
    if experiment.controlled_cart is not None:
        yield from _in_range(("controlled_cart",), experiment.controlled_cart, n)
    controller = experiment.controller
    if isinstance(controller, StateFeedbackController):
        if len(controller.gains) not in (0, 2 * n):
            yield (
                ("controller", "gains"),
                f"expected {2 * n} gains (position, velocity of each cart), "
                f"found {len(controller.gains)}",
            )
    elif controller is not None:
        yield from _in_range(("controller", "cart"), controller.cart, n)
    yield from _columns(experiment.columns or {}, n)


def _columns(columns: Mapping[str, str | int], n: int) -> Iterator[tuple[Location, str]]:
    roles = ("time", "input", "reference", "frequency", *(f"x{i}" for i in range(1, n + 1)))
    for role, column in columns.items():
        if role not in roles:
            yield ("columns", role), f"unknown column{nearest(role, roles)}"
        if isinstance(column, int) and column < 1:
            yield ("columns", role), f"columns count from 1, found {column}"


def _reported_problems(submission: Submission) -> Iterator[tuple[Location, str]]:
    reported, n = submission.reported, submission.system.carts
    if reported is None:
        return
    names = parameter_names(n, rigid=submission.system.bench.rigid)
    for table in ("initial", "final"):
        for name in getattr(reported, table):
            if name not in names:
                yield ("reported", table, name), f"unknown parameter{nearest(name, names)}"
    if (space := reported.state_space) is not None:
        if space.A and (len(space.A) != 2 * n or any(len(row) != 2 * n for row in space.A)):
            hint = _decimals(max(map(len, space.A)), n)
            yield (
                ("reported", "state_space", "A"),
                f"expected {2 * n} rows of {2 * n} numbers{hint}",
            )
        if space.B and len(space.B) != 2 * n:
            yield (
                ("reported", "state_space", "B"),
                f"expected {2 * n} numbers, found {len(space.B)}{_decimals(len(space.B), n)}",
            )
    for key, stated in (reported.effects or {}).items():
        yield from _effect_problems(key, stated, n)
    found = len(reported.feedback.gains) if reported.feedback else 0
    if found not in (0, 2 * n):
        yield (
            ("reported", "feedback", "gains"),
            f"expected {2 * n} gains, found {found}{_decimals(found, n)}",
        )


def _effect_problems(
    key: str, stated: Mapping[str, Decimal], n: int
) -> Iterator[tuple[Location, str]]:
    from pipeline.plant.catalogue import CATALOGUE

    at = ("reported", "effects", key)
    effect = next((effect for effect in CATALOGUE if effect.key == key), None)
    if effect is None:
        yield at, f"unknown effect{nearest(key, [effect.key for effect in CATALOGUE])}"
        return
    names = [p.name for p in effect.parameters if p.reported]
    places = [] if effect.place == "input" else [effect.place]
    for name in stated:
        if name not in names + places:
            yield (*at, name), f"unknown parameter{nearest(name, names + places)}"
    for place in places:
        last = n if place == "cart" else n + 1
        if place in stated and stated[place] not in range(1, last + 1):
            yield (*at, place), f"there is no {place} {stated[place]}; expected 1 to {last}"


def _decimals(found: int, n: int) -> str:
    """Return a hint at decimal commas if a list of `n` carts has twice as many numbers."""
    return "; write decimals with a point, 1.5 and not 1,5" if found == 4 * n else ""


# ------------------------------------------------------------------------- files


def posix(name: str) -> str:
    """Return a file name with forward slashes; a student may have typed it on any system."""
    return str(PurePosixPath(name.replace("\\", "/")))


def list_experiments(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the `[[experiments]]` tables of a document, which need not be valid."""
    tables = document.get("experiments")
    return [t for t in tables if isinstance(t, dict)] if isinstance(tables, list | tuple) else []


def stated_columns(document: Mapping[str, Any], file: str) -> dict[str, str | int]:
    """Return the columns that a document, valid or not, states for a file, by role."""
    own = (t for t in list_experiments(document) if posix(str(t.get("file", ""))) == file)
    stated: dict[str, str | int] = {}
    for table in (document.get("system"), *own):
        columns = table.get("columns") if isinstance(table, dict) else None
        for role, column in columns.items() if isinstance(columns, dict) else ():
            if isinstance(column, str | int):
                stated[str(role)] = column
    return stated


def path_problem(folder: Path, name: str) -> str | None:
    """Return why `name` cannot be a file inside `folder`; None if it can, even if it is missing."""
    shown = quote(name)
    if not name.strip() or not name.isprintable():
        hidden = "it contains an invisible character: rename the file"
        hint = "" if name.isprintable() else f"; {backslash_words() if _typed(name) else hidden}"
        return f"expected a file name, found {shown}{hint}"
    windows, relative = PureWindowsPath(name), Path(posix(name))
    if windows.drive or windows.root or relative.is_absolute() or ".." in windows.parts:
        return f"{shown} is outside the submission folder"
    steps = [folder / part for part in (relative, *relative.parents)[:-1]]
    with suppress(OSError, RuntimeError):  # `file_problem` reports links that cannot be followed
        linked = any(map(_may_be_link, steps))
        if linked and not steps[0].resolve().is_relative_to(folder.resolve()):
            return f"{shown} is outside the submission folder, through a link"
    return None


def _typed(name: str) -> bool:
    """Whether all invisible characters of a name may be escapes, typed as a backslash in quotes."""
    return all(c.isprintable() or unicodedata.category(c) == "Cc" for c in name)


def _may_be_link(path: Path) -> bool:
    """Whether a path may lead elsewhere: it is a link or, on Windows, a junction."""
    with suppress(OSError):
        info = path.lstat()
        return stat.S_ISLNK(info.st_mode) or bool(getattr(info, "st_reparse_tag", 0))
    return False


def file_problem(folder: Path, name: str, *, taken: Collection[str] = ()) -> str | None:
    """Return why `name` is not a readable regular file inside `folder`; None if it is one.

    The files in `taken` belong to other entries, so messages do not suggest them.
    """
    if (problem := path_problem(folder, name)) is not None:
        return problem
    shown = quote(name)
    try:
        info = (folder / posix(name)).stat()
    except FileNotFoundError:
        return f"there is no file {shown}{_near_file(folder, posix(name), taken)}"
    except OSError as error:
        if not is_file_fault(error):
            raise
        why = "a loop of links" if error.errno == errno.ELOOP else error.strerror
        return f"{shown} cannot be read ({why})"
    if stat.S_ISDIR(info.st_mode):
        return f"{shown} is a folder, expected a file"
    if not stat.S_ISREG(info.st_mode):
        return f"{shown} is not a regular file"
    if info.st_size > MAX_DATA_BYTES:
        return f"{shown} has {info.st_size:,} bytes, the limit is {MAX_DATA_BYTES:,}"
    return None


def _near_file(folder: Path, name: str, taken: Collection[str]) -> str:
    """Return "; did you mean …?" with a file of the same name, or one with a similar name.

    A file with a similar name must be in the same folder; elsewhere it may be a table written by a
    report.
    """
    try:
        paths = sorted(p for p in islice(folder.rglob("*"), 1_000) if p.is_file())
    except OSError:
        return ""
    files = [path.relative_to(folder).as_posix() for path in paths]
    files = [file for file in files if file not in taken]
    meant = PurePosixPath(name)
    same = [file for file in files if PurePosixPath(file).name.casefold() == meant.name.casefold()]
    beside = [file for file in files if PurePosixPath(file).parent == meant.parent]
    hint = f"; did you mean {same[0]!r}?" if same else nearest(name, beside)
    return hint if "did you mean" in hint else ""
