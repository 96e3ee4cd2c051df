"""Find hand-ins in folders, trees, zip files and downloads from platforms, and how late each is.

Lateness follows from the rubric's deadline. A table with the columns `submission` and `days_late`
replaces it, so it can also grant extensions.
"""

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path, PurePosixPath

from pipeline.errors import ConfigError, SubmissionError
from pipeline.grading.csv_table import read_table
from pipeline.grading.gradings import HandIn
from pipeline.grading.intake.unpack import (
    CLASS,
    DEEPEST,
    STRANGE_ARCHIVES,
    is_debris,
    list_members,
    member_names,
    names_in_pieces,
    unpack,
)
from pipeline.grading.platforms import Account, Upload, current, parse_name
from pipeline.grading.rubric import Late
from pipeline.output import DEVICE
from pipeline.submission.load import NAME
from pipeline.submission.toml import quote
from pipeline.words.progress import Progress, silent

_DAYS_OF_A_LATE_MARK = 1.0  # Canvas marks a late file without saying how late; it counts as one day
_LONGEST_ID, _MOST_BYTES = 100, 200  # characters and bytes that every system allows in a name
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f\x7f-\x9f]')
_RESULTS = ("class.html", "feedback/.made.json")  # these mark the output folder of a grading
_DATA = "data"  # folder of recordings; its name is never the id of a hand-in


@dataclass(frozen=True, kw_only=True)
class _Walk:
    """Settings of a search for hand-ins: the folders to skip, and a function that reports them."""

    skip: set[Path]
    say: Progress


def find_hand_ins(
    paths: Iterable[Path],
    *,
    scratch: Path,
    skip: Iterable[Path] = (),
    known: Iterable[str] = (),
    say: Progress = silent,
) -> tuple[HandIn, ...]:
    """Return the hand-ins in folders, trees and archives, sorted by id.

    Parameters
    ----------
    scratch : folder where archives of a whole class are unpacked.
    skip : folders that are not hand-ins, such as the output folder.
    known : ids of the current class. If a folder `team-1` has the longer id `a-team-1` in the
        class, it keeps that id, even if this run has no other `team-1`.
    say : function that is called with a message for each folder that is skipped because it holds
        results of a grading.

    Raises
    ------
    ConfigError : a path does not exist, or contains nothing to grade.
    """
    walk = _Walk(skip={path.resolve() for path in skip} | {scratch.resolve()}, say=say)
    found: list[HandIn] = []
    for number, path in enumerate(dict.fromkeys(path.resolve() for path in paths)):
        here = _find_at(path, scratch=scratch / f"class-{number}", walk=walk)
        if not here:
            raise _nothing_to_grade(path)
        found += here
    return tuple(sorted(_with_ids(found, known=known), key=lambda hand_in: hand_in.id))


def check_hand_ins(path: Path, *, skip: Iterable[Path] = ()) -> str:
    """Return why an archive of one submission cannot be graded, without unpacking it; or "".

    Such an archive becomes a submission with a reason.

    Raises
    ------
    ConfigError : the path does not exist, is a broken archive of a class, or is a folder that
        contains nothing to grade.
    """
    path = _folder_or_archive(path.resolve())
    if path.is_dir():
        skipped = {one.resolve() for one in skip}
        if not _in_folder(path, walk=_Walk(skip=skipped, say=silent)):
            raise _nothing_to_grade(path)
        return ""
    is_class = _holds_a_class(path)
    try:
        names = list_members(path, limits=CLASS)
    except SubmissionError as error:
        if is_class:
            raise ConfigError(str(error)) from None
        return str(error)
    found = any(name.name == NAME or name.suffix.lower() == ".zip" for name in names)
    return "" if found or is_class else str(_nothing_to_grade(path))


def _nothing_to_grade(path: Path) -> ConfigError:
    return ConfigError(f"{path}: nothing to grade: it has no folder or zip file with a {NAME}")


def _folder_or_archive(path: Path) -> Path:
    """Return the folder or zip file that a path means, or raise a ConfigError."""
    if path.name == NAME:
        path = path.parent
    if not path.is_dir() and not path.is_file():
        raise ConfigError(f"{path}: there is no such file or folder")
    if not path.is_dir() and path.suffix.lower() != ".zip":
        raise ConfigError(
            f"{path}: neither a folder nor a zip file; give the folder with the {NAME}"
        )
    return path


def _find_at(path: Path, *, scratch: Path, walk: _Walk) -> list[HandIn]:
    path = _folder_or_archive(path)
    if path.is_dir():
        return _in_folder(path, walk=walk)
    if not _holds_a_class(path):
        return [_archive(path)]
    folder = scratch / path.stem
    try:
        refused = unpack(path, folder, limits=CLASS)
    except SubmissionError as error:
        raise ConfigError(str(error)) from None
    found = _in_folder(folder, walk=walk)
    return _with_refused(found, refused, folder=folder)


def _with_refused(
    found: Sequence[HandIn], refused: Mapping[PurePosixPath, str], *, folder: Path
) -> list[HandIn]:
    """Return the hand-ins of an archive, including those with refused files.

    If some files of a hand-in were refused, the reason becomes its `problem`. If all its files were
    refused, the hand-in is added here.
    """
    whose = {
        source.relative_to(folder).parts: i for i, one in enumerate(found) for source in one.sources
    }
    depths = sorted({len(parts) for parts in whose}) or [1]
    problems: dict[int, str] = {}
    lost: dict[str, str] = {}
    for member, why in sorted(refused.items()):
        owner = next((i for d in depths if (i := whose.get(member.parts[:d])) is not None), None)
        if owner is None:
            lost.setdefault(member.parts[: depths[0]][-1], why)
        else:
            problems.setdefault(owner, why)
    return [
        *(HandIn(id=x, parent=folder.name, problem=why) for x, why in lost.items()),
        *(replace(one, problem=problems.get(i, one.problem)) for i, one in enumerate(found)),
    ]


def _holds_a_class(archive: Path) -> bool:
    """Return whether an archive contains many hand-ins, not just that of one student."""
    whole = member_names(archive, limits=CLASS)
    names = whole or names_in_pieces(archive)
    tops = {part for path in names for part in path.parts[:2]}
    return (
        sum(path.name == NAME for path in names) > 1
        or any(parse_name(top) is not None for top in tops)
        or (not whole and any(path.suffix.lower() == ".zip" for path in names[:1]))
        or (
            sum(path.suffix.lower() == ".zip" for path in names) > 1
            and not any(path.name == NAME for path in names)
        )
    )


# ------------------------------------------------------------------------ folders


def _in_folder(folder: Path, *, walk: _Walk, top: bool = True, depth: int = 0) -> list[HandIn]:
    """Return the hand-ins in a folder; an unreadable folder counts as one hand-in."""
    try:
        return _search_folder(folder, walk=walk, top=top, depth=depth)
    except OSError as error:
        problem = f"cannot be read ({error.strerror or error})"
        return [HandIn(id=folder.name, parent=folder.parent.name, problem=problem)]


def _search_folder(folder: Path, *, walk: _Walk, top: bool, depth: int) -> list[HandIn]:
    if _is_submission(folder) or depth > DEEPEST:
        return [HandIn(id=folder.name, parent=folder.parent.name, sources=(folder,))]
    entries = [
        entry
        for entry in sorted(folder.iterdir())
        if entry not in walk.skip and not _is_skipped(entry, walk=walk)
    ]
    uploads = {entry: upload for entry in entries if (upload := parse_name(entry.name))}
    if uploads:
        rest = [entry for entry in entries if entry not in uploads and _may_be_hand_in(entry)]
        return _from_platform(folder, uploads, top=top) + [_single(entry) for entry in rest]
    entries = [entry for entry in entries if _may_be_hand_in(entry)]
    if len(entries) == 1 and entries[0].is_dir() and not entries[0].is_symlink():
        deeper = _in_folder(entries[0], walk=walk, top=top, depth=depth + 1)
        if deeper or not top:
            return deeper
        return [_single(folder if entries[0].name.lower() == _DATA else entries[0])]
    found, without = [], []
    for entry in entries:
        if entry.suffix.lower() in STRANGE_ARCHIVES:
            without.append(_single(entry))
        elif entry.is_symlink() or not entry.is_dir():
            found.append(_single(entry))
        elif here := _in_folder(entry, walk=walk, top=False, depth=depth + 1):
            found += here
        else:
            without.append(_single(entry))
    if not found and any(entry.name.lower() == _DATA for entry in entries):
        return [_single(folder)]  # a submission that lacks its `submission.toml`
    # Below the top level, folders beside a single submission hold only the student's own files.
    return found + without if top or len(found) > 1 else found


def _is_submission(folder: Path) -> bool:
    toml = folder / NAME
    return toml.is_symlink() or toml.exists()


def _is_skipped(entry: Path, *, walk: _Walk) -> bool:
    """Return whether to skip an entry: system files, results of a grading, or hidden folders.

    A hidden folder that contains `submission.toml` is not skipped.
    """
    if not entry.is_dir() or entry.name == "__MACOSX":
        return is_debris(PurePosixPath(entry.name)) or entry.name.startswith(".")
    if os.access(entry / NAME, os.F_OK):
        return False
    if entry.name.startswith("."):
        return True
    results = entry.parent if entry.name in ("feedback", "gradescope") else entry
    if not all(os.access(results / name, os.F_OK) for name in _RESULTS):
        return False
    if results not in walk.skip:  # report it, because a student's own folder may look like results
        walk.say(
            f"{quote(f'{entry.parent.name}/{entry.name}')} is skipped: it looks like the results "
            f"of a grading; if it is a submission, remove {_RESULTS[0]} from it"
        )
    return True


def _may_be_hand_in(entry: Path) -> bool:
    return (
        entry.is_dir() or entry.is_symlink() or entry.suffix.lower() in (".zip", *STRANGE_ARCHIVES)
    )


def _single(entry: Path) -> HandIn:
    """Return a folder or an archive as one hand-in."""
    if entry.is_symlink():
        return HandIn(
            id=entry.stem,
            parent=entry.parent.name,
            problem=f"{quote(entry.name)} is a link; submit the files themselves",
        )
    if entry.is_dir():
        return HandIn(id=entry.name, parent=entry.parent.name, sources=(entry,))
    return _archive(entry)


def _archive(path: Path) -> HandIn:
    name, own = _folder_inside(path), path.stem.removesuffix(".tar")
    return HandIn(id=name or own, parent=own if name else path.parent.name, sources=(path,))


def _folder_inside(archive: Path) -> str:
    """Return the name of the one folder in an archive that holds the submission.

    Returns "" if the submission is at the top level, if several folders are possible, or if the
    archive cannot be read. A read error is reported later, when the hand-in is graded.
    """
    try:
        tomls = [path for path in member_names(archive) if path.name == NAME]
    except OSError:
        return ""
    depth = min((len(path.parts) for path in tomls), default=0)
    top = [path.parent.name for path in tomls if len(path.parts) == depth]
    return top[0] if len(top) == 1 else ""


# ---------------------------------------------------------------- learning platforms


def _from_platform(folder: Path, uploads: dict[Path, Upload], *, top: bool) -> list[HandIn]:
    """Return one hand-in per student, from any number of uploaded files."""
    # Only a metadata file at the top level is the platform's; one further down may be a student's.
    platforms = {upload.platform.name: upload.platform for upload in uploads.values()}
    metadata = {
        owner: sent
        for one in platforms.values()
        if top and one.metadata
        for owner, sent in one.metadata(folder).items()
    }
    by_student: dict[tuple[str, str, str], dict[Path, Upload]] = defaultdict(dict)
    for path, upload in uploads.items():
        own = path.name if path.is_dir() and not upload.platform.has_folders else ""
        by_student[upload.owner, upload.user, own][path] = upload
    found = []
    for (owner, _, own), files in sorted(by_student.items()):
        sources = tuple(current(files))
        inside = own or _name_inside(sources)
        sent = metadata.get(owner)
        shown = sent.names if sent and sent.names else owner
        found.append(
            HandIn(
                id=inside or shown,
                parent=shown if inside and not own else folder.name,
                sources=sources,
                owner=str(Account.of({path: files[path] for path in sources}, name=shown)),
                handed_in=sent.at if sent else "",
                days_late=_DAYS_OF_A_LATE_MARK if any(u.late for u in files.values()) else 0.0,
                problem="it is a link" if any(path.is_symlink() for path in sources) else "",
            )
        )
    return found


def _name_inside(sources: Sequence[Path]) -> str:
    """Return the name of the folder that the student packed or uploaded, or "" without a folder."""
    for source in sources:
        if source.is_dir():
            tomls = [path for path in sorted(source.rglob(NAME)) if path.parent != source]
            if tomls and not _is_submission(source):
                return min(tomls, key=lambda path: len(path.parts)).parent.name
            sources_in = [path for path in sorted(source.glob("*.zip")) if path.is_file()]
            if not tomls and not _is_submission(source) and len(sources_in) == 1:
                return _folder_inside(sources_in[0])
        elif source.suffix.lower() == ".zip" and (name := _folder_inside(source)):
            return name
    return ""


# ---------------------------------------------------------------------------- ids


def _with_ids(found: Sequence[HandIn], *, known: Iterable[str] = ()) -> list[HandIn]:
    """Name every hand-in after its folder.

    If names are equal, the parent folder is added as a prefix, and a number if that is not enough.

    Parameters
    ----------
    known : ids of the current class. A hand-in that is in the class under its name with the prefix
        keeps the prefix.
    """
    names = [fit_name(one.id) for one in found]
    longer = [fit_name(f"{one.parent}-{one.id}") for one in found]
    often, before = Counter(name.casefold() for name in names), set(known)
    names = [
        long if often[name.casefold()] > 1 or (long in before and name not in before) else name
        for name, long in zip(names, longer, strict=True)
    ]
    taken: set[str] = set()
    hand_ins = []
    for one, name in zip(found, names, strict=True):
        unique, number = name, 1
        while unique.casefold() in taken:
            number += 1
            unique = f"{name}-{number}"
        taken.add(unique.casefold())
        hand_ins.append(replace(one, id=unique, parent=""))
    return hand_ins


def fit_name(name: str) -> str:
    """Return a name that every system accepts for a folder, and that is safe to print."""
    text = unicodedata.normalize("NFC", name)
    text = _NOT_IN_NAMES.sub("_", text.encode("utf-8", "replace").decode())
    text = "".join(c if c.isprintable() else "_" for c in text)[:_LONGEST_ID]
    text = text.encode()[:_MOST_BYTES].decode(errors="ignore").strip(" .")
    return f"_{text}" if not text or DEVICE.fullmatch(text) else text


_DAY = 86_400.0  # s
_HEADS = ["submission", "days_late"]
_LONGEST = 3_650.0  # days; a larger number must be a typing error


def read_late_table(path: Path) -> dict[str, float]:
    """Return the days late by submission name; the names are in lower case.

    Raises
    ------
    ConfigError : the table lacks a column, or one of its rows is not valid.
    """
    table = read_table(path)
    if not {*_HEADS} <= {*table.columns}:
        raise ConfigError(f"{path.name}: expected columns {' and '.join(_HEADS)}")
    days: dict[str, float] = {}
    for line, *cells in table.loc[:, _HEADS].itertuples():
        who, typed = (str(cell).strip() for cell in cells[:2])
        late = _number(typed)
        if late is None or not 0 <= late <= _LONGEST:
            raise ConfigError(f"{path.name} line {line}: days_late: cannot read {quote(typed)}")
        if days.get(who.casefold(), late) != late:
            raise ConfigError(
                f"{path.name} line {line}: {late:g} days late here, and "
                f"{days[who.casefold()]:g} in an earlier line: keep one of them"
            )
        if who:
            days[who.casefold()] = late
    return days


def settle_lateness(
    hand_ins: Iterable[HandIn], *, late: Late, table: Mapping[str, float]
) -> tuple[list[HandIn], list[str]]:
    """Return the hand-ins with their lateness, and the names in the table that match no hand-in.

    The table takes precedence over the deadline, and the deadline over a platform's late mark.
    """
    settled, known = [], set()
    for hand_in in hand_ins:
        days = table.get(hand_in.id.casefold())
        known.add(hand_in.id.casefold())
        if days is None and late.due is not None and hand_in.handed_in:
            waited = datetime.fromisoformat(hand_in.handed_in) - late.due
            days = max(0.0, waited.total_seconds() / _DAY)
        settled.append(hand_in if days is None else replace(hand_in, days_late=days))
    return settled, [name for name in table if name not in known]


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", ".") or 0)
    except ValueError:
        return None
