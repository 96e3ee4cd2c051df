"""Unpack archives from strangers: write only inside the target folder, within limits."""

import io
import re
import stat
import struct
import sys
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from mmap import ACCESS_READ, mmap
from pathlib import Path, PurePosixPath
from typing import IO

from pipeline.errors import SubmissionError, is_name_fault
from pipeline.output import DEVICE
from pipeline.submission.toml import quote

_RATIO_FROM = 1_000_000  # bytes; the ratio of smaller files is not limited
# The end record of a zip file and its comment are within this number of bytes from the end.
_END_OF_ZIP = 66_000
# The end record (APPNOTE.TXT 4.3.16) states the position of the table of contents at the offset
# `_PLACE`. If the position is `_ELSEWHERE`, a 64-bit record states it.
_PLACE, _ELSEWHERE = 16, 0xFFFFFFFF
DEEPEST = 40  # nested folders; a submission needs three
_AGAIN = ": send or download it once more"
_UTF8_NAME, _ENCRYPTED = 0x800, 0x1
# Each file in an archive begins with a header (APPNOTE.TXT 4.3.7). The group in the pattern is the
# length of the file's name.
_HEAD = 30  # bytes
_MEMBER = re.compile(rb"PK\x03\x04.{22}(..)..", re.DOTALL)

# On Windows a colon starts a stream, and a final dot is dropped.
_NOT_ON_WINDOWS = re.compile(r'[<>:"|?*\x00-\x1f]|[. ]$')

# Archives that cartlab cannot open; the message asks for a zip file instead.
STRANGE_ARCHIVES = (".7z", ".bz2", ".gz", ".rar", ".tar", ".tbz", ".tgz", ".xz", ".zst")


@dataclass(frozen=True, kw_only=True)
class UnpackLimits:
    """Limits for unpacking one archive.

    Attributes
    ----------
    members : largest number of files.
    total : largest number of bytes of all unpacked files together.
    ratio : largest ratio of a file's unpacked size to its packed size.
    directory : largest number of bytes of the table of contents.
    whole : whether one bad file makes cartlab refuse the whole archive, not only that file.
    """

    members: int = 2_000
    total: int = 300_000_000  # bytes
    ratio: float = 200.0
    directory: int = 2_000_000
    whole: bool = True


HAND_IN = UnpackLimits()
CLASS = UnpackLimits(
    members=200_000, total=50_000_000_000, ratio=1e4, directory=24_000_000, whole=False
)


@dataclass(kw_only=True)
class _Budget:
    """How many files and bytes may still be read from an archive."""

    limits: UnpackLimits
    members: int = field(init=False)
    total: int = field(init=False)

    def __post_init__(self) -> None:
        self.members, self.total = self.limits.members, self.limits.total


def is_debris(path: PurePosixPath) -> bool:
    """Return whether a file is one that macOS or Windows creates by itself."""
    name = path.name.lower()
    return (
        "__MACOSX" in path.parts
        or name in (".ds_store", "thumbs.db", "desktop.ini")
        or name.startswith(("._", "~$"))
    )


def unpack(archive: Path, into: Path, *, limits: UnpackLimits) -> dict[PurePosixPath, str]:
    """Unpack a zip archive into a new folder; return which files were refused, and why.

    Only regular files are written.

    Raises
    ------
    SubmissionError : the file is not a zip archive, or it is broken, encrypted or too large; the
        message has one line.
    OSError : this computer cannot read or write, for example because its disk is full.
    """
    shown = quote(archive.name)
    if archive.is_file() and not archive.stat().st_size:
        raise SubmissionError(f"{shown}: is empty (0 bytes){_AGAIN}")
    into.mkdir(parents=True)
    try:
        with _opened(archive, limits=limits) as opened:
            return _extract(opened, into, budget=_Budget(limits=limits))
    except _TROUBLE as error:
        raise _as_submission_error(error, shown=shown) from None


def member_names(archive: Path, *, limits: UnpackLimits = HAND_IN) -> list[PurePosixPath]:
    """Return the names of the files that may be unpacked; empty if the file is not an archive.

    Raises
    ------
    OSError : this computer cannot read the archive now.
    """
    try:
        return list_members(archive, limits=limits)
    except SubmissionError:
        return []


def list_members(archive: Path, *, limits: UnpackLimits) -> list[PurePosixPath]:
    """Return the names of the files that may be unpacked; nothing is unpacked.

    Files that macOS or Windows created are left out.

    Raises
    ------
    SubmissionError : the file is not a zip archive, or it is broken or too large.
    OSError : this computer cannot read the archive now.
    """
    shown = quote(archive.name)
    if not archive.is_file():  # reading a pipe would block
        raise SubmissionError(f"{shown}: is not a file")
    try:
        with _opened(archive, limits=limits) as opened:
            infos = [info for info in opened.infolist() if not info.is_dir()]
    except _TROUBLE as error:
        raise _as_submission_error(error, shown=shown) from None
    paths = []
    for info in infos:
        with suppress(_Refused):
            paths.append(_path(info))
    return [path for path in paths if not is_debris(path)]


def names_in_pieces(archive: Path) -> list[PurePosixPath]:
    """Return the names of files in an archive whose table of contents is missing.

    The names are found by searching for the headers of files. Files in archives inside the archive
    are found too, so the names are good enough to recognise the archive, but not to unpack it.
    """
    if not archive.is_file() or not archive.stat().st_size:
        return []
    with archive.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        heads = islice(_MEMBER.finditer(content), CLASS.members)
        ends = [(head.end(), int.from_bytes(head[1], "little")) for head in heads]
        names = [content[at : at + length].decode(errors="replace") for at, length in ends]
    return [PurePosixPath(name) for name in names if not name.endswith("/")]


class _Refused(Exception):
    """A file in an archive is refused."""


class _TooLarge(_Refused):
    """An archive exceeds the limits."""


# All errors that can occur when arbitrary bytes are read as an archive.
_TROUBLE = (
    _Refused,
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    RuntimeError,
)


def _let_through(error: Exception) -> None:
    """Re-raise an error that was caused by this computer and not by the archive."""
    if isinstance(error, OSError) and not is_name_fault(error):
        raise error


def _as_submission_error(error: Exception, *, shown: str) -> SubmissionError:
    """Return the error of an archive in one line; an error of this computer is raised instead."""
    _let_through(error)
    again = _AGAIN if isinstance(error, zipfile.BadZipFile) else ""
    return SubmissionError(f"{shown}: {_why(error)}{again}")


def _why(error: Exception) -> str:
    """Return what is wrong with an archive, in one line."""
    if isinstance(error, _Refused):
        return str(error)
    if isinstance(error, NotImplementedError):
        return "its compression is not supported"
    if isinstance(error, OSError | RuntimeError):  # from the disk or from a decoder
        message = getattr(error, "strerror", None) or _line(error)
        return f"cannot be unpacked ({message})"
    message = _line(error)
    # Details in brackets would only repeat this error.
    more = "" if message == "File is not a zip file" else f" ({message})"
    return f"not a complete zip archive{more}"


class _Bounded(io.BufferedReader):
    """A file that refuses to read too many bytes at once.

    `zipfile` reads the whole table of contents at once, and an archive may state any length for it.
    """

    def __init__(self, path: Path, *, most: int) -> None:
        super().__init__(io.FileIO(path))
        self._most = max(most, _END_OF_ZIP)

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > self._most:
            raise _TooLarge(f"its table of contents of {size:,} bytes is too large")
        # `zipfile` asks for -1 bytes to read the end of the file with its comment.
        return super().read(size)


@contextmanager
def _opened(archive: Path, *, limits: UnpackLimits) -> Iterator[zipfile.ZipFile]:
    """Open an archive whose size and table of contents are within the limits."""
    size = archive.stat().st_size
    if size > limits.total:
        raise _TooLarge(f"{size:,} bytes, the limit is {limits.total:,}")
    with _Bounded(archive, most=limits.directory) as file, zipfile.ZipFile(file) as opened:
        if _is_cut(file, opened.start_dir):
            raise zipfile.BadZipFile("its own table of contents is missing")
        if _overlap(opened.infolist(), end=opened.start_dir):
            raise _Refused("two of its files share the same bytes, as in no archive of a person")
        yield opened


def _is_cut(file: IO[bytes], contents: int) -> bool:
    """Return whether the end of the archive is cut off.

    If it is cut off, `zipfile` may find the table of contents of another archive inside this one.
    The position that the end record states for that table is then wrong. A self-extracting archive
    also states a wrong position, but begins with a program.
    """
    file.seek(0)
    if not _MEMBER.match(file.read(_HEAD)):
        return False
    file.seek(max(file.seek(0, io.SEEK_END) - _END_OF_ZIP, 0))
    end = file.read(_END_OF_ZIP)
    (stated,) = struct.unpack_from("<L", end, end.rindex(b"PK\x05\x06") + _PLACE)
    return stated not in (contents, _ELSEWHERE)


def _overlap(members: Sequence[zipfile.ZipInfo], *, end: int) -> bool:
    """Return whether members share bytes; a small archive could then unpack to a huge one.

    Parameters
    ----------
    end : where the table of contents begins.
    """
    if not members:
        return False
    places = sorted((info.header_offset, info.compress_size) for info in members)
    begins = [*(begin for begin, _ in places[1:]), end]
    return any(
        begin + _HEAD + size > after for (begin, size), after in zip(places, begins, strict=True)
    )


def _extract(opened: zipfile.ZipFile, into: Path, *, budget: _Budget) -> dict[PurePosixPath, str]:
    refused: dict[PurePosixPath, str] = {}
    members: dict[PurePosixPath, zipfile.ZipInfo] = {}
    for info in opened.infolist():
        budget.members -= 1
        if budget.members < 0:
            raise _TooLarge(f"more than {budget.limits.members:,} files")
        try:
            path = _path(info)
        except _Refused as error:
            refused.setdefault(_inside(info.filename), str(error))
            continue
        if not info.is_dir() and not is_debris(path):
            members[path] = info  # if two files have the same name, the later one counts
    for path, info in members.items():
        target = into / path
        try:
            if info.flag_bits & _ENCRYPTED:
                raise _Refused("is encrypted; pack it without a password")
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise _Refused(
                    f"{quote(str(path))} is packed by an unusual method; pack it again as a plain "
                    "zip (method Deflate)"
                )
            target.parent.mkdir(parents=True, exist_ok=True)
            with opened.open(info) as packed, target.open("xb") as file:
                _copy(packed, file, info, budget=budget, shown=str(path))
        except _TooLarge:
            raise
        except OSError as error:  # for example, a name that is too long
            _let_through(error)
            reason = f"{quote(str(path))} cannot be written ({error.strerror or _line(error)})"
            refused.setdefault(path, reason)
        except _TROUBLE as error:
            if budget.limits.whole:
                raise
            target.unlink(missing_ok=True)  # it may be incomplete
            refused.setdefault(path, _why(error))
    return refused


def _copy(
    packed: IO[bytes],
    file: IO[bytes],
    info: zipfile.ZipInfo,
    *,
    budget: _Budget,
    shown: str,
) -> None:
    """Unpack one file and count its bytes, because the size in its header may be false."""
    size = 0
    while chunk := packed.read(1 << 16):
        size += len(chunk)
        budget.total -= len(chunk)
        if budget.total < 0:
            raise _TooLarge(f"unpacks to more than {budget.limits.total:,} bytes")
        if size > max(_RATIO_FROM, budget.limits.ratio * info.compress_size):
            raise _Refused(
                f"{quote(shown)} unpacks to more than {budget.limits.ratio:g} times its size"
            )
        file.write(chunk)


def _path(info: zipfile.ZipInfo) -> PurePosixPath:
    """Return where to write a file, relative to the target folder.

    Raises
    ------
    _Refused : the file is a link or a device, or its name is not safe.
    """
    name = _decoded(info).replace("\\", "/")
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind == stat.S_IFLNK:
        raise _Refused(f"{quote(name)} is a link")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise _Refused(f"{quote(name)} is not a regular file")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or (name[1:2] == ":" and name[:1].isalpha()):
        raise _Refused(f"{quote(name)} points outside the archive")
    if not path.parts or "\0" in name:
        raise _Refused("a file without a name")
    if sys.platform == "win32" and any(
        _NOT_ON_WINDOWS.search(part) or DEVICE.fullmatch(part) for part in path.parts
    ):
        raise _Refused(f"{quote(name)} is not a valid file name on Windows")
    if len(path.parts) > DEEPEST:
        raise _Refused(f"{quote(name)} is more than {DEEPEST} folders deep")
    return path


def _decoded(info: zipfile.ZipInfo) -> str:
    """Return the name of a file; macOS packs names in UTF-8 without declaring it."""
    name = info.filename
    if not info.flag_bits & _UTF8_NAME:
        try:
            name = name.encode("cp437").decode("utf-8")
        except UnicodeError:
            name = info.filename
    return unicodedata.normalize("NFC", name)


def _inside(name: str) -> PurePosixPath:
    """Return the name of a refused file as a path that stays inside the archive."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    return PurePosixPath(unicodedata.normalize("NFC", "/".join(parts) or "nameless"))


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
