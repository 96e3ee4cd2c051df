"""Copy the files of a hand-in to a private folder and find the submission in it.

The copy is graded, on this machine or on a cluster. Only regular files are copied, and links are
not followed, so that the same files are hashed, sent and graded.
"""

import hashlib
import io
import os
import shutil
import stat
import zipfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from pipeline.errors import SubmissionError
from pipeline.grading.intake.unpack import (
    HAND_IN,
    STRANGE_ARCHIVES,
    is_debris,
    unpack,
)
from pipeline.grading.platforms import parse_name
from pipeline.submission.load import NAME
from pipeline.submission.toml import quote
from pipeline.words.numbers import first_few

_DEEPEST = 12  # levels of folders that are searched in a hand-in
_FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # so that the same files give the same archive


class Changed(Exception):
    """The files of a hand-in changed after its key was computed."""


def digest(sources: Sequence[Path], *, without: Collection[str] = ()) -> str:
    """Return the SHA-256 hash of those files of a hand-in that are graded.

    If a file cannot be read, the error is hashed instead; grading then reports the error.

    Parameters
    ----------
    without : names of files to leave out.
    """
    total = hashlib.sha256()
    try:
        for name, path in _files(sources):
            if name not in without:
                total.update(_line(name, path))
    except OSError as error:
        total.update(f"cannot be read: {error.errno}\n".encode())
    return total.hexdigest()


def _line(name: str, path: Path) -> bytes:
    with path.open("rb") as file:
        own = hashlib.file_digest(file, "sha256").hexdigest()
    return f"{len(name)} {name} {own}\n".encode()


def packed(sources: Sequence[Path]) -> bytes:
    """Return a hand-in as one zip archive, to send to another machine."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, path in _files(sources):
            info = zipfile.ZipInfo(name, _FIXED_TIME)
            archive.writestr(info, path.read_bytes(), zipfile.ZIP_DEFLATED, 1)
    return buffer.getvalue()


def unpacked(archive: bytes, into: Path) -> None:
    """Write the files of a `packed` archive into a folder."""
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        opened.extractall(into)


def open_submission(sources: Sequence[Path], into: Path, *, digest: str = "") -> Path:
    """Copy or unpack a hand-in into a folder; return the folder with `submission.toml`.

    Archives in the hand-in are opened only if there is no `submission.toml` outside them.

    Parameters
    ----------
    digest : expected hash of the copied files, as returned by `digest`; "" to accept any files.

    Raises
    ------
    SubmissionError : there is no submission, there are several, there are too many files, or an
        archive is bad.
    OSError : this computer cannot read or copy a file.
    Changed : the copied files do not have the expected hash.
    """
    into.mkdir(parents=True, exist_ok=True)
    total = hashlib.sha256()
    files = list(_files(sources))
    for name, path in files:
        target = into / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        total.update(_line(name, target))
    if digest and total.hexdigest() != digest:
        raise Changed
    if len(files) > HAND_IN.members:
        raise SubmissionError(
            f"more than {HAND_IN.members:,} files; submit {NAME}, notes.md and the files they name"
        )
    left = HAND_IN
    for _ in range(3):  # archives in archives
        if _submissions(into):
            break
        for path in [path for path in _below(into) if path.suffix.lower() == ".zip"]:
            folder = path.with_suffix("")
            if folder.exists():
                folder = path.with_name(f"{path.stem} (unpacked)")
            refused = unpack(path, folder, limits=left)
            if refused:
                raise SubmissionError(f"{quote(path.name)}: {next(iter(refused.values()))}")
            path.unlink()
            sizes = [path.stat().st_size for path in _below(folder)]
            members, total = left.members - 1 - len(sizes), left.total - sum(sizes)
            left = replace(left, members=members, total=total)
    if tomls := _submissions(into):
        folder = _only_submission(tomls, into)
        _gather_loose(folder)
        return folder
    raise SubmissionError(_nothing_in(into))


def _files(sources: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Yield each file to grade as (name relative to the hand-in, path), sorted by name.

    If the files together are too large, the largest are left out: probably videos, because data
    files are small. `submission.toml` is left out only if it alone is too large.

    If there are too many files, one more than the limit is kept, so that every machine refuses the
    hand-in. A recording too large to be read is also kept, so that it is not reported as missing.
    Invalid bytes in names are replaced.
    """
    found: list[tuple[int, str, Path]] = []
    for source in sources:
        if source.is_dir():
            found += _walk(source, PurePosixPath())
        elif (info := source.lstat()) and stat.S_ISREG(info.st_mode):
            upload = parse_name(source.name)
            name = upload.file if upload and upload.file else source.name
            found.append((info.st_size, PurePosixPath(name.replace("\\", "/")).name, source))
    chosen, left = {}, HAND_IN.total
    found.sort(key=lambda one: (PurePosixPath(one[1]).name != NAME, *one[:2]))
    for size, name, path in found[: HAND_IN.members + 1]:
        left -= size
        if left < 0:
            break
        chosen[name.encode("utf-8", "replace").decode()] = path
    yield from sorted(chosen.items())


def _walk(folder: Path, below: PurePosixPath) -> Iterator[tuple[int, str, Path]]:
    if len(below.parts) > _DEEPEST:
        return
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            name = below / entry.name
            if is_debris(name):
                continue
            if entry.is_dir(follow_symlinks=False):
                yield from _walk(Path(entry.path), name)
            elif entry.is_file(follow_symlinks=False):
                yield entry.stat(follow_symlinks=False).st_size, str(name), Path(entry.path)


def _below(folder: Path) -> list[Path]:
    """Return all files in a folder and its subfolders, sorted.

    Raises
    ------
    OSError : a folder cannot be read. (`rglob` would treat such a folder as empty.)
    """

    def refuse(error: OSError) -> None:
        raise error

    return sorted(
        Path(at) / name for at, _, names in os.walk(folder, onerror=refuse) for name in names
    )


def _submissions(folder: Path) -> list[Path]:
    """Return the `submission.toml` files at the least depth below a folder."""
    tomls = [path for path in _below(folder) if path.name == NAME]
    depth = min((len(path.parts) for path in tomls), default=0)
    return [path for path in tomls if len(path.parts) == depth]


def _only_submission(tomls: Sequence[Path], into: Path) -> Path:
    if len(tomls) > 1:
        names = " and ".join(quote(path.relative_to(into).as_posix()) for path in tomls[:2])
        more = f" and {len(tomls) - 2} more" if len(tomls) > 2 else ""
        raise SubmissionError(f"which one should be graded? There are {names}{more}")
    return tomls[0].parent


def _gather_loose(folder: Path) -> None:
    """Copy the files next to `submission.toml` into a new folder `data/`, unless it exists.

    Some platforms accept only single files, so the folder structure is lost.
    """
    data = folder / "data"
    if not os.path.lexists(data):
        loose = [path for path in folder.iterdir() if path.is_file() and path.name != NAME]
        data.mkdir()
        for path in loose:
            shutil.copyfile(path, data / path.name)


def _nothing_in(into: Path) -> str:
    files = _below(into)
    if not files:
        return f"no {NAME} in it: it is empty"
    named = first_few([quote(path.name) for path in files], 3)
    strange = [path.name for path in files if path.suffix.lower() in STRANGE_ARCHIVES]
    hint = f"; {quote(strange[0])} cannot be opened; submit a zip file" if strange else ""
    return f"no {NAME} in it, only {named}{hint}"
