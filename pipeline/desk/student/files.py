"""The files of a submission: uploads, within the limits of a hand-in, and what is handed in.

An upload never overwrites another file. Only workers read the files; the desk itself copies their
bytes.
"""

import os
import re
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from pipeline.desk.browse import free_path, is_taken, numbered
from pipeline.desk.jobs import WorkerPool
from pipeline.desk.last_report import NOTES, PDF, find_state
from pipeline.desk.page_request import Message
from pipeline.desk.served_files import scratch_folder
from pipeline.errors import SubmissionError
from pipeline.grading.intake.unpack import HAND_IN, is_debris, unpack
from pipeline.grading.self_check.answers import FILE as CHECKS
from pipeline.ingest.files import ENDINGS
from pipeline.lock import lock_when_free
from pipeline.output import DEVICE, own_folder, write_file
from pipeline.processes import Failed
from pipeline.submission import load_submission
from pipeline.submission.load import (
    MAX_DATA_BYTES,
    MAX_NOTES_BYTES,
    MAX_TOML_BYTES,
    NAME,
    file_problem,
)
from pipeline.submission.toml import decoded, parse_toml, quote

# Text files that an uploaded zip may contain, with their largest size in bytes. They do not
# overwrite an existing valid file.
_TEXTS = {NAME: MAX_TOML_BYTES, "notes.md": MAX_NOTES_BYTES}
_ASIDE = "set-aside"  # folder for recordings that are not part of the submission


def take_uploads(
    sent: Iterable[tuple[str, BinaryIO]], folder: Path, *, workers: WorkerPool
) -> list[Message]:
    """Let a worker store uploaded files; return messages about unexpected results."""
    names = []
    with scratch_folder() as scratch:
        for number, (name, content) in enumerate(sent):
            names.append(name)
            with (scratch / str(number)).open("xb") as file:
                shutil.copyfileobj(content, file)
        try:
            lines = workers.do("store_files", folder=str(folder), names=names, scratch=str(scratch))
        except Failed as error:
            return [
                Message(f"Your files were not uploaded, or not all of them: {error}", "refused")
            ]
    return [Message(**line) for line in lines]


def store(names: Sequence[str], scratch: Path, folder: Path) -> list[Message]:
    """Store files and the content of zip files; return messages about unexpected results.

    Parameters
    ----------
    names : the names as sent; the content of the first file is `0` in `scratch`, and so on.
    """
    messages: list[Message | None] = []
    found: list[tuple[str, Path]] = []
    for number, name in enumerate(names):
        content = scratch / str(number)
        if PurePosixPath(name.replace("\\", "/")).suffix.lower() != ".zip":
            found.append((name, content))
            continue
        try:
            found += _unpack(content, scratch / f"{number}-files")
        except SubmissionError as error:
            messages.append(_refuse(name, error))
    with lock_when_free(folder):
        room = _Room(folder)
        for name, path in found:
            try:
                with path.open("rb") as file:
                    messages.append(_take(name, file.read(MAX_DATA_BYTES + 1), folder, room=room))
            except SubmissionError as error:
                messages.append(_refuse(name, error))
    return [line for line in messages if line]


def _refuse(name: str, error: Exception) -> Message:
    return Message(f"{quote(name)}: not uploaded: {error}", "refused")


def _unpack(archive: Path, into: Path) -> list[tuple[str, Path]]:
    """Unpack a zip within the limits of a hand-in; return the names and paths of its files."""
    if refused := unpack(archive, into, limits=HAND_IN):
        raise SubmissionError(next(iter(refused.values())))
    files = sorted(path for path in into.rglob("*") if path.is_file())
    names = [path.relative_to(into) for path in files]
    return [
        (name.as_posix(), path)
        for name, path in zip(names, files, strict=True)
        if not is_debris(PurePosixPath(name.as_posix()))
    ]


class _Room:
    """Count the files and bytes that a submission may still receive during one upload.

    Files that were set aside, or made by a command, are not part of the submission and do not
    count.
    """

    def __init__(self, folder: Path) -> None:
        present = [folder / name for name in (NAME, *BESIDE)]
        present += own_folder(folder, "data").rglob("*")
        sizes = [path.stat().st_size for path in present if path.is_file()]
        self._files, self._bytes = len(sizes), sum(sizes)

    def check(self, raw: bytes) -> None:
        """Refuse a file for which there is no room; otherwise count it."""
        if len(raw) > MAX_DATA_BYTES:
            raise SubmissionError(f"larger than {MAX_DATA_BYTES:,} bytes")
        if self._files >= HAND_IN.members or self._bytes + len(raw) > HAND_IN.total:
            raise SubmissionError(
                f"a submission has at most {HAND_IN.members:,} files and {HAND_IN.total:,} bytes"
            )
        self._files, self._bytes = self._files + 1, self._bytes + len(raw)


def _take(sent_name: str, raw: bytes, folder: Path, *, room: _Room) -> Message | None:
    """Store a file. If its name is taken or not valid, use another name and return a message."""
    last = PurePosixPath(sent_name.replace("\\", "/")).name
    if last in _TEXTS:
        _check_text(raw, last)
        if _is_sound(folder, last):
            raise SubmissionError("it exists already and was not changed")
        room.check(raw)
        write_file(folder / last, raw)
        return None
    if PurePosixPath(last).suffix.casefold() not in ENDINGS:
        raise SubmissionError(f"the name of a recording ends in {', '.join(ENDINGS)}")
    # Replace invisible marks and unusual spaces.
    printable = "".join(c if c.isprintable() else "-" for c in last)
    # Bytes count, not characters: most systems allow 255, some fewer.
    name = printable.encode(errors="ignore")[-120:].decode(errors="ignore")
    # Replace characters that some systems refuse, and names that Windows reserves.
    name = re.sub(r'[<>:"/\\|?*\x00-\x1f\x7f]|^[. ~]+|[. ]+$', "-", name)
    if DEVICE.fullmatch(name):
        name = f"data-{name}"
    names = numbered(own_folder(folder, "data") / name)
    target = next(path for path in names if not is_taken(path) or _holds(path, raw))
    if is_taken(target):
        return Message(f"{quote(last)}: already exists", "changed")
    room.check(raw)
    target.parent.mkdir(exist_ok=True)
    write_file(target, raw)
    why = "" if printable == last else "; names may not contain invisible characters"
    if target.name == last:
        return None
    return Message(f"{quote(last)}: saved as {target.name}{why}", "changed")


def _holds(path: Path, raw: bytes) -> bool:
    return not path.is_symlink() and path.is_file() and path.read_bytes() == raw


def put_aside(file: str, folder: Path) -> str:
    """Move a recording from `data/` to the folder for other files; return a message.

    No file is overwritten. The caller must hold the lock of the folder.

    Raises
    ------
    SubmissionError : the recording no longer exists.
    """
    aside = own_folder(folder, _ASIDE)
    aside.mkdir(exist_ok=True)
    target = free_path(aside / PurePosixPath(file).name)
    try:
        (folder / file).rename(target)
    except FileNotFoundError:
        raise SubmissionError(f"{file}: was moved or removed in the meantime") from None
    return f"{quote(file)} is now in {_ASIDE}/{target.name}, and not part of the report or the zip."


def _check_text(raw: bytes, name: str) -> None:
    """Refuse a text file that cannot be read."""
    text = decoded(raw, where=name, limit=_TEXTS[name], error=SubmissionError)
    if name == NAME:
        parse_toml(text, where=name, error=SubmissionError)


def _is_sound(folder: Path, name: str) -> bool:
    """Return whether the folder has a text file of this name that can be read."""
    if file_problem(folder, name) is not None:
        return False
    try:
        _check_text((folder / name).read_bytes(), name)
    except SubmissionError:
        return False
    return True


# ----------------------------------------------------------------------------- the files to hand in

BESIDE = (NOTES, CHECKS, PDF)
_MADE = ("report", "gap", "solution")  # folders of computed results, which contain no recordings


def list_held(folder: Path, *, report: bool = True) -> list[str]:
    """Return the names of the files in the zip.

    Raises
    ------
    SubmissionError : the submission is not valid.
    """
    named = [experiment.file for experiment in load_submission(folder).experiments]
    files = [file for file in named if not _is_made(folder, file)]
    return list(dict.fromkeys([NAME, *files, *list_beside(folder, report=report)]))


def list_beside(folder: Path, *, report: bool = True) -> list[str]:
    """Return which files of `BESIDE` go into the zip; an outdated report is left out."""
    left_out = "" if report and find_state(folder) == "current" else PDF
    return [name for name in BESIDE if name != left_out and file_problem(folder, name) is None]


def list_missing(folder: Path) -> list[str]:
    """Return the reasons why a submission cannot be handed in."""
    try:
        submission = load_submission(folder)
    except SubmissionError as error:
        return [str(error)]
    files = dict.fromkeys(experiment.file for experiment in submission.experiments)
    found = [problem for file in files if (problem := file_problem(folder, file)) is not None]
    found += [
        f"{file} is computed from recordings; use the recording itself"
        for file in files
        if _is_made(folder, file)
    ]
    return found or ([] if files else ["it has no experiments yet"])


def _is_made(folder: Path, name: str) -> bool:
    """Return whether a file, or the target of its link, is in a folder of computed results."""
    root = folder.resolve()
    places = (Path(os.path.normpath(root / name)), (folder / name).resolve())
    return any(place.is_relative_to(root / made) for place in places for made in _MADE)
