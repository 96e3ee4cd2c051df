"""Data files: the recordings in each, in any format, and the files of a folder that have some."""

import hashlib
import os
import re
import signal
import sys
import threading
from base64 import b64decode, b64encode
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import SubmissionError, is_file_fault
from pipeline.ingest.columns import is_time
from pipeline.ingest.labview import is_lvm, is_tdms, read_lvm, read_tdms
from pipeline.ingest.matlab import is_mat, read_mat
from pipeline.ingest.table import FileTable, Format, Variable
from pipeline.ingest.text import read_text
from pipeline.ingest.workbook import is_workbook, read_workbook
from pipeline.processes import Ended, Failed, Supervisor, limited_memory, serve
from pipeline.submission.load import file_problem
from pipeline.words.numbers import first_few

# Endings of data files.
ENDINGS = (
    ".txt", ".csv", ".xlsx", ".mat", ".m", ".tdms", ".lvm", ".log", ".dat", ".tsv", ".asc",
)  # fmt: skip
# For each format, a function that recognises it and one that reads it; all other files are text.
_READERS: tuple[tuple[Callable[[bytes], bool], Callable[..., list[FileTable]]], ...] = (
    (is_mat, read_mat),
    (is_workbook, read_workbook),
    (is_lvm, read_lvm),
    (is_tdms, read_tdms),
)

MOST_MEMORY = 900_000_000  # bytes to read one file; the largest recording takes 850,000,000
MOST_SECONDS = 30.0  # of processor time to read one file; the largest recording takes ten
_OUT_OF_TIME = "signal 24"  # SIGXCPU, on Linux and macOS
# Whether a file that crashes its reader may not end this process, as when it grades or imports.
OF_STRANGERS: ContextVar[bool] = ContextVar("OF_STRANGERS", default=False)

# First bytes of files that are submitted by mistake, and the advice to give.
_BY_MISTAKE = (
    (b"PK\x03\x04", "a zip archive, or a document of LibreOffice: save the sheet as .xlsx or CSV"),
    (b"\xd0\xcf\x11\xe0", "an old Excel workbook, or a locked one; save it as .xlsx, unlocked"),
    (b"\x89HDF", "an HDF5 file that MATLAB did not write; save the recording as CSV"),
    (b"\x1f\x8b", "a gzip archive; unpack it"),
    (b"%PDF", "a PDF document; export the recording as CSV"),
    (b"\x89PNG", "a picture; export the recording as CSV"),
    (b"\xff\xd8\xff", "a picture; export the recording as CSV"),
)


def read_tables(
    folder: Path, name: str, *, shown: str | None = None, taken: Collection[str] = ()
) -> tuple[list[FileTable], str]:
    """Return the recordings in a data file and the SHA-256 of its bytes.

    Messages call the file `shown`, by default its name. If the file is missing, similar names are
    suggested, except those in `taken`.

    Raises
    ------
    SubmissionError : the file is outside the folder, missing, of unknown format or broken; the
        message names the line.
    OSError : the computer cannot read the file now, whatever its content.
    """
    if (problem := file_problem(folder, name, taken=taken)) is not None:
        raise SubmissionError(problem if shown is None else f"{shown}: {problem}")
    source = shown or name
    try:
        raw = (folder / name).read_bytes()
    except OSError as error:
        if not is_file_fault(error):
            raise
        raise SubmissionError(f"{source}: cannot be read ({error.strerror})") from None
    if is_mat(raw) and OF_STRANGERS.get():
        tables = _parse_apart(raw, source=source)
    else:
        with _limited(source):
            tables = parse_tables(raw, source=source)
    return tables, hashlib.sha256(raw).hexdigest()


def read_table(
    folder: Path, name: str, *, shown: str | None = None, taken: Collection[str] = ()
) -> tuple[FileTable, str]:
    """Return the only recording in a data file; otherwise as `read_tables`."""
    tables, digest = read_tables(folder, name, shown=shown, taken=taken)
    return choose_run(tables), digest


def choose_run(tables: Sequence[FileTable], run: str | int | None = None) -> FileTable:
    """Return one of the recordings of a file: the only one, or that of a run.

    Raises
    ------
    SubmissionError : the run is missing, or the file has several runs and the choice is open.
    """
    if run is None and len(tables) == 1:
        return tables[0]
    labels = [table.run for table in tables]
    source, shown = tables[0].source, first_few([repr(label) for label in labels], 8)
    if run is None:
        raise SubmissionError(
            f"{source}: holds several recordings ({shown}); say which: run = {labels[0]!r}, or "
            "let `cartlab fill` write one experiment for each"
        )
    if str(run) in labels:
        return tables[labels.index(str(run))]
    if isinstance(run, int) and 1 <= run <= len(tables):
        return tables[run - 1]
    raise SubmissionError(f"{source}: run {run!r} is missing; it has {shown or 'only one'}")


class _TooLong(BaseException):
    """Reading a file took too long; no reader may catch it."""


@contextmanager
def _limited(source: str) -> Iterator[None]:
    """Limit the time and memory for reading one file, so that it costs only its own recording.

    Processor time does not depend on the load of the computer. On Windows, and outside the main
    thread, there are no such limits; there, those of the whole submission remain.

    Raises
    ------
    SubmissionError : the limit is exceeded.
    """
    here = threading.current_thread() is threading.main_thread()
    if sys.platform == "win32" or not here or signal.getitimer(signal.ITIMER_VIRTUAL)[0]:
        yield
        return

    def stop(*_: object) -> None:
        raise _TooLong

    before, own = signal.signal(signal.SIGVTALRM, stop), False
    try:
        try:
            # Again every second: Python drops an exception in a callback of its garbage collector.
            signal.setitimer(signal.ITIMER_VIRTUAL, MOST_SECONDS, 1.0)
            with limited_memory(MOST_MEMORY) as own:
                yield
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            signal.signal(signal.SIGVTALRM, before)
    except _TooLong:
        fault = _too_costly(source)
    except MemoryError:
        if not own:  # the whole submission needs more than it may
            raise
        fault = _too_costly(source, memory=True)
    else:
        return
    raise fault


def _too_costly(source: str, *, memory: bool = False) -> SubmissionError:
    """Return the error for a file whose reading takes too much time or memory."""
    why = f"takes more than {MOST_SECONDS:g} s of processor time to read"
    if memory:
        why = f"needs more than {MOST_MEMORY / 1e9:g} GB of memory to read"
    return SubmissionError(f"{source}: {why}; save the recording as CSV")


@cache
def _reader() -> Supervisor:
    """Return the process that reads files which may crash it."""
    return Supervisor(__name__, memory=2 * MOST_MEMORY)


def _parse_apart(raw: bytes, *, source: str) -> list[FileTable]:
    """Return the recordings of a file that may crash its reader, from a process of its own.

    Raises
    ------
    SubmissionError : as for `parse_tables`, or the process crashed.
    """
    task = {"raw": b64encode(raw).decode("ascii"), "source": source}
    try:
        # On a busy computer, the processor time takes less than ten minutes.
        answer = _reader().do(task, limit=600.0)
    except Ended as error:
        if error.how in ("start", "stopped"):
            raise OSError(str(error)) from error
        if error.how == "memory":
            raise _too_costly(source, memory=True) from None
        if error.how == "time" or error.status == _OUT_OF_TIME:
            raise _too_costly(source) from None
        raise SubmissionError(f"{source}: the .mat file is damaged or truncated") from None
    except Failed as error:  # a fault of this program, not of the file
        raise RuntimeError(str(error)) from error
    if "refused" in answer:
        raise SubmissionError(answer["refused"])
    return [_unpacked(table) for table in answer["tables"]]


def _parse_here(task: dict[str, str], _: object) -> dict[str, Any]:
    """Return the recordings of a file as plain data; this runs in the process of `_reader`.

    If a library never returns to Python, `_limited` cannot stop it; then the process is ended.
    """
    if sys.platform != "win32":
        import resource

        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (ceil(used + MOST_SECONDS) + 5, hard))
    try:
        with _limited(task["source"]):
            tables = parse_tables(b64decode(task["raw"]), source=task["source"])
    except SubmissionError as error:
        return {"refused": str(error)}
    plain = [
        asdict(table) | {"values": b64encode(table.values.tobytes()).decode("ascii")}
        for table in tables
    ]
    return {"tables": plain}


def _unpacked(plain: dict[str, Any]) -> FileTable:
    """Return the table that `_parse_here` made plain; a `.mat` file has no lines."""
    values = np.frombuffer(b64decode(plain["values"])).reshape(len(plain["names"]), -1)
    made = dict[str, Any](plain)
    made |= {key: tuple(plain[key]) for key in ("names", "whole", "notes")}
    made["variables"] = tuple(
        Variable(**(one | {"size": tuple(one["size"])})) for one in plain["variables"]
    )
    made |= {"format": Format(**plain["format"]), "values": values}
    return FileTable(**made)


def is_recording(head: bytes) -> bool:
    """Return whether a binary file with these first bytes may hold a recording."""
    return any(is_theirs(head) for is_theirs, _ in _READERS)


def parse_table(raw: bytes, *, source: str) -> FileTable:
    """Return the columns of a data file with one recording, from its bytes."""
    return choose_run(parse_tables(raw, source=source))


def parse_tables(raw: bytes, *, source: str) -> list[FileTable]:
    """Return the recordings of a data file from its bytes, each with its own `run`."""
    read = next((read for is_theirs, read in _READERS if is_theirs(raw)), None)
    if read is None:
        for start, what in _BY_MISTAKE:
            if raw.startswith(start):
                raise SubmissionError(f"{source}: {what}")
        read = read_text
    tables = _joined(read(raw, source=source))
    if len(tables) == 1:
        return tables
    labels = [table.run for table in tables]
    if len(set(labels)) < len(labels) or not all(labels):
        labels = [str(i) for i in range(1, len(tables) + 1)]
    return [replace(table, run=label) for table, label in zip(tables, labels, strict=True)]


def _joined(tables: Sequence[FileTable]) -> list[FileTable]:
    """Return the recordings of a file; pieces that continue each other in time are one."""
    recordings: list[list[FileTable]] = []
    for table in tables:
        if recordings and _continues(recordings[-1][-1], table):
            recordings[-1].append(table)
        else:
            recordings.append([table])
    return [parts[0] if len(parts) == 1 else _as_one(parts) for parts in recordings]


def _as_one(parts: Sequence[FileTable]) -> FileTable:
    notes = dict.fromkeys(note for part in parts for note in part.notes)
    return replace(
        parts[0],
        values=np.hstack([part.values for part in parts]),
        whole=tuple(map(all, zip(*(part.whole for part in parts), strict=True))),
        lines=np.concatenate([part.lines for part in parts if part.lines is not None]),
        cut=parts[-1].cut,
        ends_broken=parts[-1].ends_broken,
        notes=(*notes, f"{len(parts)} segments that continue each other were joined"),
    )


def _continues(before: FileTable, after: FileTable) -> bool:
    """Return whether a table has the same columns as the one before, at later times."""
    if before.names != after.names or before.lines is None or after.lines is None or before.cut:
        return False
    times = [i for i, name in enumerate(before.names) if is_time(name)]
    return bool(times and after.values[times[0], 0] > before.values[times[0], -1])


# ------------------------------------------------------------------------------------------ folders

# files of operating systems whose names do not begin with a dot
_DEBRIS = frozenset({"thumbs.db", "desktop.ini"})
_AS_TEXT = "save the recording as .csv"
# Formats that are not read but may hold a recording, with the advice to give.
_FORMS = {
    ".xlsm .xlsb .xls .ods .numbers": ("a spreadsheet", "save each recording as .xlsx or .csv"),
    ".zip .rar .7z .gz .tgz .tar": ("an archive", "unpack it"),
    ".h5 .hdf5 .npy .npz .parquet": ("a data format that cartlab does not read", _AS_TEXT),
    ".json .xml .out": ("a data format that cartlab does not read", _AS_TEXT),
    ".fig": ("a MATLAB figure", "save its data as .csv"),
    ".doc .docx .rtf .pdf": ("a document", "save a table of numbers in it as .csv"),
}
_FORM_OF = {ending: form for endings, form in _FORMS.items() for ending in endings.split()}


@dataclass(frozen=True, kw_only=True)
class NotRead:
    """A file that is not read.

    Attributes
    ----------
    file : its name, printable.
    reason : why it is not read.
    advice : what to do if it may hold a recording; otherwise empty.
    """

    file: str
    reason: str
    advice: str


def data_files_in(folder: Path) -> list[Path]:
    """Return the files that may hold data, in a folder and its subfolders; "2" precedes "10"."""
    return [path for path in _entries(folder) if _has_data_ending(path)]


def files_not_read(folder: Path, *, root: Path) -> list[NotRead]:
    """Return the files of a folder and its subfolders that are no data files, with advice.

    Folders that may not be opened are listed too. Names are relative to `root`; links that lead out
    of `root` are not followed. Hidden files are skipped.
    """
    names = [p.relative_to(root).as_posix() for p in _entries(folder) if not _has_data_ending(p)]
    return [refused(root, name) or _not_read(root, name) for name in names]


def refused(root: Path, name: str) -> NotRead | None:
    """Return why a file below `root` must not be opened; None if it may be opened."""
    problem = file_problem(root, name)
    if problem is None:
        return None
    link = (root / name).is_symlink()
    if not link and _closed(root / name):
        problem = "this folder cannot be opened (Permission denied)"
    advice = "replace the link with the file itself" if link else ""
    shown = name if name.isprintable() else name.encode("unicode_escape").decode("ascii")
    return NotRead(file=shown, reason=problem, advice=advice)


def recordings_beside(folder: Path, *, named: Iterable[str]) -> list[NotRead]:
    """Return the recordings outside `data/`, except those `named` in submission.toml."""
    known = set(named)
    found = []
    for path in sorted(folder.iterdir(), key=_natural) if folder.is_dir() else ():
        name = path.name
        if _is_hidden(name) or name in known or not _has_data_ending(path):
            continue
        if file_problem(folder, name) is None and _is_table(folder, name):
            reason = "it is outside data/, and only files in data/ are read"
            found.append(NotRead(file=name, reason=reason, advice="move it into data/"))
    return found


def not_read_notes(found: Iterable[tuple[str, str, str]]) -> list[str]:
    """Return one line per reason and advice, with the files concerned."""
    about: dict[str, list[str]] = {}
    for file, reason, advice in found:
        about.setdefault("; ".join(filter(None, (reason, advice))), []).append(file)
    # The sentence names four files; the JSON output names all.
    return [f"not read: {first_few(names, 4)} ({why})" for why, names in about.items()]


def _not_read(root: Path, name: str) -> NotRead:
    """Return why a file is not read: because of its ending or, if unknown, its content."""
    ending = Path(name).suffix.casefold()
    if ending in _FORM_OF:
        reason, advice = _FORM_OF[ending]
        return NotRead(file=name, reason=reason, advice=advice)
    what = f"its ending is {ending}" if ending else "its name has no ending"
    if _is_table(root, name):
        return NotRead(
            file=name, reason=f"a table of numbers, but {what}", advice="rename it to end in .csv"
        )
    return NotRead(file=name, reason="no recording", advice="")


def _is_table(root: Path, name: str) -> bool:
    try:
        with (root / name).open("rb") as file:
            # 1000 bytes show whether a file is text.
            head = file.read(1000)
        # The file is not read whole, because a video may be large.
        if b"\0" in head and not is_recording(head):
            return False
        read_table(root, name)
    except (SubmissionError, OSError):
        return False
    return True


def _has_data_ending(path: Path) -> bool:
    return path.suffix.casefold() in ENDINGS and path.is_file()


def _entries(folder: Path) -> list[Path]:
    """Return all files in a folder and its subfolders, and the folders that may not be read.

    Links are not followed.
    """
    return sorted(_walk(folder), key=_natural)


def _walk(folder: Path) -> Iterator[Path]:
    if _closed(folder):
        yield folder
    for path in folder.rglob("*"):
        if any(map(_is_hidden, path.relative_to(folder).parts)):
            continue
        if path.is_symlink() or not path.is_dir() or _closed(path):
            yield path


def _closed(folder: Path) -> bool:
    """Return whether a folder exists, but its files may not be listed."""
    try:
        with os.scandir(folder):
            return False
    except OSError as error:  # of others, such as a missing folder, the caller knows already
        return isinstance(error, PermissionError)


def _is_hidden(name: str) -> bool:
    return name.startswith((".", "~")) or name.casefold() in _DEBRIS


def _natural(path: Path) -> list[tuple[str, int]]:
    parts = re.findall(r"(\D*)(\d{0,9})", path.as_posix().casefold())
    return [(text, int(n or -1)) for text, n in parts]


if __name__ == "__main__":
    serve(lambda: _parse_here)
