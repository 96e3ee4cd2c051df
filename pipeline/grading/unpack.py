"""Unpack what strangers packed: never outside the folder, never more than fits."""

import stat
import struct
import unicodedata
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO

from pipeline.errors import SubmissionError
from pipeline.submission.complaints import quote

_CHUNK = 1 << 16
_RATIO_FROM = 1_000_000  # bytes; a smaller file may be as empty as it likes
_END, _END_SIGNATURE = struct.Struct("<4s4H2LH"), b"PK\x05\x06"
_LONGEST_COMMENT = 65_535
_UTF8_NAME, _ENCRYPTED = 0x800, 0x1

_DEBRIS_FOLDERS = ("__MACOSX",)
_DEBRIS_FILES = (".ds_store", "thumbs.db", "desktop.ini")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an archive may be; `ratio` of a file's size to its packed size."""

    members: int = 2_000
    total: int = 300_000_000  # bytes
    ratio: float = 200.0
    directory: int = 2_000_000  # bytes of the archive's table of contents


HAND_IN = Limits()
CLASS = Limits(members=200_000, total=50_000_000_000, ratio=1e4, directory=100_000_000)


@dataclass(kw_only=True)
class _Budget:
    """What is left of the limits while an archive is read."""

    limits: Limits
    members: int = field(init=False)
    total: int = field(init=False)

    def __post_init__(self) -> None:
        self.members, self.total = self.limits.members, self.limits.total


def is_debris(path: PurePosixPath) -> bool:
    """Tell what macOS and Windows leave behind from what was handed in."""
    name = path.name.lower()
    return (
        any(part in _DEBRIS_FOLDERS for part in path.parts)
        or name in _DEBRIS_FILES
        or name.startswith(("._", "~$"))
    )


def unpack(archive: Path, into: Path, *, limits: Limits) -> dict[str, str]:
    """Unpack a zip archive into a new folder; return what was refused: top entry and reason.

    Only regular files are written. One bad member of a class's archive costs the hand-in it
    belongs to (its top entry), not the others.

    Raises
    ------
    SubmissionError : not a zip archive, broken, encrypted, or larger than the limits; one line.
    """
    shown = quote(archive.name)
    into.mkdir(parents=True)
    try:
        _refuse_long_contents(archive, limits=limits)
        with zipfile.ZipFile(archive) as opened:
            return _extract(opened, into, budget=_Budget(limits=limits))
    except _Refused as error:
        raise SubmissionError(f"{shown}: {error}") from None
    except NotImplementedError:
        raise SubmissionError(f"{shown}: packed in a way that is not supported") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, struct.error) as error:
        raise SubmissionError(f"{shown}: not a whole zip archive ({_line(error)})") from None
    except OSError as error:
        raise SubmissionError(f"{shown}: cannot be unpacked ({error.strerror})") from None
    except RuntimeError as error:  # an archive with a password, or a decoder's complaint
        raise SubmissionError(f"{shown}: cannot be unpacked ({_line(error)})") from None


def member_names(archive: Path, *, limits: Limits = HAND_IN) -> list[PurePosixPath]:
    """Return the files in an archive that are no debris; none where it is none or too large."""
    try:
        _refuse_long_contents(archive, limits=limits)
        with zipfile.ZipFile(archive) as opened:
            paths = [_path(info) for info in opened.infolist() if not info.is_dir()]
    except (_Refused, zipfile.BadZipFile, OSError, ValueError, struct.error, NotImplementedError):
        return []
    return [path for path in paths if not is_debris(path)]


class _Refused(Exception):
    """A member that must not be unpacked, or an archive beyond the limits."""


def _refuse_long_contents(archive: Path, *, limits: Limits) -> None:
    """Refuse an archive whose table of contents alone would fill the memory."""
    size = archive.stat().st_size
    if size > limits.total:
        raise _Refused(f"{size:,} bytes, the limit is {limits.total:,}")
    with archive.open("rb") as file:
        file.seek(max(0, size - _END.size - _LONGEST_COMMENT))
        tail = file.read()
    at = tail.rfind(_END_SIGNATURE)
    if at < 0 or len(tail) - at < _END.size:
        raise _Refused("not a whole zip archive (it has no end)")
    _, _, _, _, _, directory, _, _ = _END.unpack_from(tail, at)
    # A 64-bit archive says 2^32 - 1 here; no class needs one.
    if directory > limits.directory:
        raise _Refused(f"a table of contents of {directory:,} bytes")


def _extract(opened: zipfile.ZipFile, into: Path, *, budget: _Budget) -> dict[str, str]:
    refused: dict[str, str] = {}
    members: dict[PurePosixPath, zipfile.ZipInfo] = {}
    for info in opened.infolist():
        budget.members -= 1
        if budget.members < 0:
            raise _Refused(f"more than {budget.limits.members:,} files")
        try:
            path = _path(info)
        except _Refused as error:
            refused.setdefault(_top(info.filename), str(error))
            continue
        if not info.is_dir() and not is_debris(path):
            members[path] = info  # of two with one name, the later
    for path, info in members.items():
        if info.flag_bits & _ENCRYPTED:
            raise _Refused("is encrypted; pack it without a password")
        target = into / path
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with opened.open(info) as packed, target.open("xb") as file:
                _copy(packed, file, info, budget=budget, shown=str(path))
        except OSError as error:  # a file where a folder should be, a name that is too long
            reason = f"{quote(str(path))} cannot be written ({error.strerror})"
            refused.setdefault(path.parts[0], reason)
    return refused


def _copy(
    packed: IO[bytes],
    file: IO[bytes],
    info: zipfile.ZipInfo,
    *,
    budget: _Budget,
    shown: str,
) -> None:
    """Copy a member, counting what truly comes out: its header may say anything."""
    size = 0
    while chunk := packed.read(_CHUNK):
        size += len(chunk)
        budget.total -= len(chunk)
        if budget.total < 0:
            raise _Refused(f"unpacks to more than {budget.limits.total:,} bytes")
        if size > max(_RATIO_FROM, budget.limits.ratio * info.compress_size):
            raise _Refused(
                f"{quote(shown)} unpacks to more than {budget.limits.ratio:g} times its size"
            )
        file.write(chunk)


def _path(info: zipfile.ZipInfo) -> PurePosixPath:
    """Return where a member goes, below the folder it is unpacked into."""
    name = _decoded(info).replace("\\", "/")
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise _Refused(f"{quote(name)} is a link")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise _Refused(f"{quote(name)} is not a regular file")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or (name[1:2] == ":" and name[:1].isalpha()):
        raise _Refused(f"{quote(name)} leaves the archive")
    if not path.parts or "\0" in name:
        raise _Refused("a file without a name")
    return path


def _decoded(info: zipfile.ZipInfo) -> str:
    """Return the name as it was meant: macOS packs UTF-8 without saying so."""
    name = info.filename
    if not info.flag_bits & _UTF8_NAME:
        try:
            name = name.encode("cp437").decode("utf-8")
        except UnicodeError:
            name = info.filename
    return unicodedata.normalize("NFC", name)


def _top(name: str) -> str:
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return unicodedata.normalize("NFC", parts[0]) if parts else ""


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
