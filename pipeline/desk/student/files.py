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
from pipeline.output import own_folder, write_file
from pipeline.submission.complaints import quote
from pipeline.submission.load import MAX_DATA_BYTES, NAME

_TEXTS = (NAME, "notes.md")  # that a packed submission brings; those that are there already stay
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
        if (folder / last).exists():
            raise SubmissionError("there is one already, which stays as it is")
        _store(raw, folder / last, folder)
        return ""
    if PurePosixPath(last).suffix.casefold() not in ENDINGS:
        raise SubmissionError(f"a recording ends in {', '.join(ENDINGS)}")
    name = _UNFIT.sub("-", last)[-_LONGEST:]
    if _RESERVED.fullmatch(name):
        name = f"data-{name}"
    target = own_folder(folder, "data") / name
    number = 1
    while target.exists() or target.is_symlink():
        if not target.is_symlink() and target.is_file() and target.read_bytes() == raw:
            return f"{quote(last)}: is there already"
        number += 1
        target = target.with_name(f"{Path(name).stem}-{number}{Path(name).suffix}")
    _store(raw, target, folder)
    return f"{quote(last)}: taken as {target.name}" if target.name != last else ""


def _store(raw: bytes, target: Path, folder: Path) -> None:
    """Write a file where the folder has room for it by a hand-in's limits."""
    if len(raw) > MAX_DATA_BYTES:
        raise SubmissionError(f"larger than {MAX_DATA_BYTES:,} bytes")
    there = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    if len(there) >= HAND_IN.members or sum(there) + len(raw) > HAND_IN.total:
        raise SubmissionError(
            f"a hand-in has at most {HAND_IN.members:,} files and {HAND_IN.total:,} bytes"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    write_file(target, raw)
