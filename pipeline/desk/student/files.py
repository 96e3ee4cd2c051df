"""What is uploaded, into `data/`: by the limits of a hand-in, over no other file."""

import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from pipeline.desk.jobs import Failed, Hand
from pipeline.errors import SubmissionError
from pipeline.grading.intake.unpack import HAND_IN, is_debris
from pipeline.ingest.formats.table import ENDINGS
from pipeline.lock import turn_in
from pipeline.output import TURN, own_folder, write_file
from pipeline.submission.complaints import quote
from pipeline.submission.load import (
    MAX_DATA_BYTES,
    MAX_NOTES_BYTES,
    MAX_TOML_BYTES,
    NAME,
    outside,
)
from pipeline.submission.toml_file import decoded, parse_toml

# Texts that a packed submission brings, and their most bytes; what is there and sound stays.
_TEXTS = {NAME: MAX_TOML_BYTES, "notes.md": MAX_NOTES_BYTES}
_UNFIT = re.compile(r'[<>:"/\\|?*\x00-\x1f\x7f]|^[. ~]+|[. ]+$')  # in no name, on any system
_RESERVED = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_LONGEST = 120  # letters of a name


def take_upload(name: str, content: BinaryIO, folder: Path, *, hand: Hand) -> list[str]:
    """Store an uploaded file, or what is in an archive; return what a person would not expect."""
    try:
        if PurePosixPath(name.replace("\\", "/")).suffix.lower() == ".zip":
            said = list(_take_archive(content, folder, hand=hand))
        else:
            said = [_take(name, content, folder)]
    except (SubmissionError, Failed) as error:
        said = [f"{quote(name)}: not taken: {error}"]
    return [line for line in said if line]


def _take_archive(content: BinaryIO, folder: Path, *, hand: Hand) -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="cartlab-") as scratch:
        archive, into = Path(scratch) / "upload.zip", Path(scratch) / "files"
        with archive.open("xb") as file:
            shutil.copyfileobj(content, file)
        for member in hand.do("unpack", archive=str(archive), into=str(into)):
            if is_debris(PurePosixPath(member)):
                continue
            with (into / member).open("rb") as file:
                try:
                    yield _take(member, file, folder)
                except SubmissionError as error:
                    yield f"{quote(member)}: not taken: {error}"


def _take(given: str, content: BinaryIO, folder: Path) -> str:
    """Store a file, under another name where its own is of something else; say if so."""
    last = PurePosixPath(given.replace("\\", "/")).name
    raw = content.read(MAX_DATA_BYTES + 1)
    if last in _TEXTS:
        _check_text(raw, last)
        with turn_in(folder):
            if _is_sound(folder, last):
                raise SubmissionError("there is one already, which stays as it is")
            _check_room(raw, folder)
            write_file(folder / last, raw)
        return ""
    if PurePosixPath(last).suffix.casefold() not in ENDINGS:
        raise SubmissionError(f"a recording ends in {', '.join(ENDINGS)}")
    name = _UNFIT.sub("-", last)[-_LONGEST:]
    if _RESERVED.fullmatch(name):
        name = f"data-{name}"
    with turn_in(folder):
        target = own_folder(folder, "data") / name
        number = 1
        while target.exists() or target.is_symlink():
            if not target.is_symlink() and target.is_file() and target.read_bytes() == raw:
                return f"{quote(last)}: is there already"
            number += 1
            target = target.with_name(f"{Path(name).stem}-{number}{Path(name).suffix}")
        _check_room(raw, folder)
        target.parent.mkdir(exist_ok=True)
        write_file(target, raw)
    return f"{quote(last)}: taken as {target.name}" if target.name != last else ""


def _check_text(raw: bytes, name: str) -> None:
    """Refuse what nothing could be read from."""
    text = decoded(raw, where=name, limit=_TEXTS[name], error=SubmissionError)
    if name == NAME:
        parse_toml(text, where=name, error=SubmissionError)


def _is_sound(folder: Path, name: str) -> bool:
    """Return whether there is such a text that can be read."""
    if outside(folder, name) is not None:
        return False
    try:
        _check_text((folder / name).read_bytes(), name)
    except SubmissionError:
        return False
    return True


def _check_room(raw: bytes, folder: Path) -> None:
    """Refuse what the folder has no room for by a hand-in's limits."""
    if len(raw) > MAX_DATA_BYTES:
        raise SubmissionError(f"larger than {MAX_DATA_BYTES:,} bytes")
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != TURN)
    there = [path.stat().st_size for path in files]
    if len(there) >= HAND_IN.members or sum(there) + len(raw) > HAND_IN.total:
        raise SubmissionError(
            f"a hand-in has at most {HAND_IN.members:,} files and {HAND_IN.total:,} bytes"
        )
