"""Make and change `submission.toml`; comments, order and all other digits are kept."""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array

from pipeline.errors import ConfigError, PipelineError, SubmissionError
from pipeline.lock import lock_when_free
from pipeline.names import parameter_names
from pipeline.output import write_file
from pipeline.resources import TEMPLATES
from pipeline.submission.load import (
    MAX_TOML_BYTES,
    NAME,
    file_problem,
    parse_submission,
    spring_names,
)
from pipeline.submission.models import MOST_CARTS, Submission
from pipeline.submission.toml import Value, read_text, toml_value


class Stale(PipelineError):
    """A file was changed by others after an edit was prepared; `text` is its present content."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(
            f"{name}: was changed in the meantime, by another program or in another window"
        )
        self.text = text


def submission_text(folder: Path) -> str:
    """Return the text of a folder's `submission.toml`.

    Raises
    ------
    SubmissionError : the file cannot be read.
    """
    where = f"{folder.resolve().name}/{NAME}"
    if (problem := file_problem(folder, NAME)) is not None:
        raise SubmissionError(f"{where}: {problem}")
    return read_text(folder / NAME, where=where, limit=MAX_TOML_BYTES, error=SubmissionError)


def text_digest(text: str) -> str:
    """Return a digest that identifies the content of a file."""
    return hashlib.sha256(text.encode()).hexdigest()


def require_version(text: str, version: str, *, name: str) -> None:
    """Refuse an edit that was prepared for another text.

    Parameters
    ----------
    version : digest of the text for which the edit was prepared.
    name : name of the file in the message.

    Raises
    ------
    Stale : the text is another one now.
    """
    if version != text_digest(text):
        raise Stale(name, text)


def edit_submission(
    folder: Path, change: Callable[[tomlkit.TOMLDocument], None], *, version: str = ""
) -> Submission:
    """Change the document of a submission; write it only if the result is valid.

    Parameters
    ----------
    change : function that changes the document.
    version : digest of the text for which the change was prepared; empty to change any text.

    Raises
    ------
    SubmissionError : the result would be invalid (`InvalidSubmission`), or the file cannot be
        changed in this way.
    Stale : the file's text is not the one for which the change was prepared.
    """
    with lock_when_free(folder):
        text = submission_text(folder)
        if version:
            require_version(text, version, name=NAME)
        where = f"{folder.resolve().name}/{NAME}"
        try:
            new = edit_text(text, change, where=where, error=SubmissionError)
        except ValueError:  # an integer of thousands of digits
            parse_submission(text, folder=folder, where=where)  # raises if the file was invalid
            raise SubmissionError(f"{where}: a number has too many digits") from None
        except (TypeError, AttributeError, LookupError):
            parse_submission(text, folder=folder, where=where)  # raises if the file lacks a table
            raise
        new = re.sub(r"(?<!\n)\n{3,}(?=\[\[experiments\]\])", "\n\n", new).rstrip() + "\n"
        if len(new.encode()) > MAX_TOML_BYTES:
            raise SubmissionError(f"{where}: would exceed {MAX_TOML_BYTES:,} bytes")
        submission = parse_submission(new, folder=folder, where=where)
        newline = "\r\n" if "\r\n" in text else "\n"
        content = new.replace("\n", newline).encode()
        # A file that stays as it is keeps its time, so no report becomes out of date.
        if (folder / NAME).read_bytes() != content:
            write_file(folder / NAME, content)
        return submission


def edit_text(
    text: str,
    change: Callable[[tomlkit.TOMLDocument], None],
    *,
    where: str,
    error: type[PipelineError],
) -> str:
    """Return a TOML text, with plain line ends, after a change of its document.

    Parameters
    ----------
    where : name of the file in messages.
    error : class of error to raise if the text cannot be changed in this way.
    """
    try:
        document = tomlkit.parse(text.replace("\r\n", "\n"))
        change(document)
        return tomlkit.dumps(document)
    except (TOMLKitError, RecursionError) as wrong:
        raise error(f"{where}: cannot be edited by cartlab ({wrong})") from None


def append_experiment(
    document: tomlkit.TOMLDocument, entry: Mapping[str, Value], *, remarks: Sequence[str] = ()
) -> None:
    """Add an `[[experiments]]` table after the last one, with remarks as comments at its end."""
    there: Any = document.get("experiments")
    inline = isinstance(there, Array)
    table: Any = tomlkit.inline_table() if inline else tomlkit.table()
    for key, value in entry.items():
        table.add(key, toml_item(value))
    if inline:
        there.append(table)
        return
    for remark in remarks:
        table.add(tomlkit.comment(comment_text(remark)))
    table.add(tomlkit.nl())
    before = tomlkit.dumps(document) if there is None else there[-1].as_string()
    table.trivia.indent = "" if not before or before.endswith("\n\n") else "\n"
    if there is None:
        there = tomlkit.aot()
        there.append(table)
        document.append("experiments", there)
    else:
        there.append(table)


def comment_text(remark: str) -> str:
    """Return a remark that is safe after a #, whatever characters a file's name contains."""
    plain = "".join(c if c.isprintable() else " " for c in remark)
    return plain if len(plain) <= 300 else plain[:299] + "…"


def toml_item(value: Value) -> Any:
    """Return a plain value as an item of a document, with tables inline."""
    return tomlkit.value(toml_value(value))


# --------------------------------------------------------------------------------- a new submission

NOTES_TEMPLATE = (TEMPLATES / "notes.md").read_text(encoding="utf-8")


def new_submission(folder: Path, *, carts: int) -> None:
    """Write `submission.toml`, `notes.md` and an empty `data/` for a bench with `carts` carts.

    Raises
    ------
    ConfigError : the folder is not empty, or the number of carts is too large.
    """
    if not 1 <= carts <= MOST_CARTS:
        raise ConfigError(f"carts: expected 1 to {MOST_CARTS}, found {carts}")
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: exists already and is not empty; choose a new folder")
    write_templates(folder, carts=carts)


def write_templates(folder: Path, *, carts: int, examples: bool = True) -> None:
    """Write the files of `new_submission` into a folder that may already hold recordings.

    An existing `submission.toml` or `notes.md` stays as it is.

    Parameters
    ----------
    examples : whether to write all keys as comments, instead of a link to the documentation.
    """
    # Imported late, because this takes 50 ms.
    import jinja2

    source = (TEMPLATES / f"{NAME}.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = environment.from_string(source).render(
        carts=carts,
        examples=examples,
        springs=["true"] * (carts + 1),
        spring_names=spring_names(carts),
        ratio_names=[f"x{i}" for i in range(1, carts + 1)],
        zeros=["0.0"] * (2 * carts),
        names=parameter_names(carts),
    )
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for name, content in ((NAME, text), ("notes.md", NOTES_TEMPLATE)):
        if not (folder / name).exists():
            write_file(folder / name, content)
