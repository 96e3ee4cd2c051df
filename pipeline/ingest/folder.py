"""List the files of a folder: which hold recordings, and why others are not read."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.recognise import ENDINGS, is_recording, read_table
from pipeline.submission.load import file_problem
from pipeline.words.numbers import first_few

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
    return [path for path in _entries(folder) if _is_recording(path)]


def files_not_read(folder: Path, *, root: Path) -> list[NotRead]:
    """Return the files of a folder and its subfolders that are no data files, with advice.

    Names are relative to `root`; links that lead out of `root` are not followed. Hidden files are
    skipped.
    """
    names = [p.relative_to(root).as_posix() for p in _entries(folder) if not _is_recording(p)]
    return [refused(root, name) or _not_read(root, name) for name in names]


def refused(root: Path, name: str) -> NotRead | None:
    """Return why a file below `root` must not be opened; None if it may be opened."""
    problem = file_problem(root, name)
    if problem is None:
        return None
    link = (root / name).is_symlink()
    advice = "replace the link with the file itself" if link else ""
    shown = name if name.isprintable() else name.encode("unicode_escape").decode("ascii")
    return NotRead(file=shown, reason=problem, advice=advice)


def recordings_beside(folder: Path, *, named: Iterable[str]) -> list[NotRead]:
    """Return the recordings outside `data/`, except those `named` in submission.toml."""
    known = set(named)
    found = []
    for path in sorted(folder.iterdir(), key=_natural) if folder.is_dir() else ():
        name = path.name
        if _is_hidden(name) or name in known or not _is_recording(path):
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


def _is_recording(path: Path) -> bool:
    return path.suffix.casefold() in ENDINGS and path.is_file()


def _entries(folder: Path) -> list[Path]:
    """Return all files in a folder and its subfolders; links are not followed."""
    return sorted(_walk(folder), key=_natural)


def _walk(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*"):
        if any(map(_is_hidden, path.relative_to(folder).parts)):
            continue
        if path.is_symlink() or not path.is_dir():
            yield path


def _is_hidden(name: str) -> bool:
    return name.startswith((".", "~")) or name.casefold() in _DEBRIS


def _natural(path: Path) -> list[tuple[str, int]]:
    parts = re.findall(r"(\D*)(\d{0,9})", path.as_posix().casefold())
    return [(text, int(n or -1)) for text, n in parts]
