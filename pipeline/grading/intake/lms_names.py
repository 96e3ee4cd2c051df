"""Read owner and lateness from the file names of learning platforms.

Canvas (`lib/content_zipper.rb`) uses `doejane_LATE_1024_77001_lab3.zip` or, with anonymous grading,
`LATE_anon_x7Yb2_77001_lab3.zip`. A file that is submitted again is called `lab3-1.zip`.

Moodle (`mod/assign/classes/downloader.php`) uses `Jane Doe_1024_assignsubmission_file_` as a folder
name or at the beginning of a file name. For a group, the name and number are those of the group.

Gradescope uses a folder `submission_77001`, next to a file `submission_metadata.yml`.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

Platform = Literal["canvas", "moodle", "gradescope"]

# A last group `.+` or `.*` takes all remaining characters, including line ends. A pattern that
# always matches to the end needs no backtracking.
_CANVAS = re.compile(
    r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+)_(?P<upload>\d+)_(?P<file>.+)", re.DOTALL
)
_CANVAS_NAMELESS = re.compile(
    r"(?P<late>LATE_)?(?P<owner>anon_(?P<user>\w{5}))_(?P<upload>\d+)_(?P<file>.+)", re.DOTALL
)
_CANVAS_TEXT = re.compile(
    r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+)_(?P<file>(?:text|link)\.html)", re.DOTALL
)
_MOODLE = re.compile(
    r"(?P<owner>.+?)(?:_(?P<user>\d+))?_assignsubmission_(?:file|onlinetext)(?:_(?P<file>.*))?",
    re.DOTALL,
)
_GRADESCOPE = re.compile(r"(?P<owner>submission_\d+)(?P<file>\.\w+)?")
_ATTEMPT = re.compile(r"(?P<stem>.+)-(?P<attempt>\d{1,3})(?P<suffix>(?:\.\w+)?)")
_OWNER = re.compile(
    r"(?P<name>.*?)(?: \((?:(?P<platform>canvas|moodle|gradescope) )?(?P<number>\d+)\))?", re.DOTALL
)
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.\d*)? ?(Z|UTC|[+-]\d\d:?\d\d)")
_METADATA = re.compile(r"(?:submission_)?metadata\.ya?ml")
_MOST_METADATA = 10_000_000  # most bytes of the metadata file


@dataclass(frozen=True, kw_only=True)
class Upload:
    """The parts of a downloaded name: owner, lateness, and the student's own file name.

    Attributes
    ----------
    user : number of the account on the platform.
    number : number of this upload on the platform; later uploads have larger numbers.
    """

    platform: Platform
    owner: str
    user: str
    late: bool = False
    file: str = ""
    number: int = 0


def parse_name(name: str) -> Upload | None:
    """Read the name of a downloaded file or folder; None if no platform made it."""
    if found := _MOODLE.fullmatch(name):
        return Upload(
            platform="moodle",
            owner=found["owner"],
            user=found["user"] or "",
            file=found["file"] or "",
        )
    if found := _GRADESCOPE.fullmatch(name):
        user = found["owner"].removeprefix("submission_")
        file = name if found["file"] else ""
        return Upload(platform="gradescope", owner=found["owner"], user=user, file=file)
    canvas = (_CANVAS_NAMELESS, _CANVAS, _CANVAS_TEXT)
    if found := next((found for form in canvas if (found := form.fullmatch(name))), None):
        return Upload(
            platform="canvas",
            owner=found["owner"],
            user=found["user"],
            late=found["late"] is not None,
            file=found["file"],
            number=int(found.groupdict().get("upload", 0)),
        )
    return None


def current(uploads: Mapping[Path, Upload]) -> list[Path]:
    """Return one student's files without those that a later upload replaces.

    Canvas appends `-1`, `-2` to the name of a file that is submitted again.
    """
    names = {upload.file for upload in uploads.values()}
    attempts: dict[str, list[tuple[int, int, Path]]] = defaultdict(list)
    for path, upload in uploads.items():
        again = _ATTEMPT.fullmatch(upload.file)
        first = f"{again['stem']}{again['suffix']}" if again else upload.file
        # `run-2.csv` is a second upload only if `run.csv` exists too.
        if again and first in names:
            attempts[first].append((int(again["attempt"]), upload.number, path))
        else:
            attempts[upload.file or path.name].append((0, upload.number, path))
    return sorted(max(files)[-1] for files in attempts.values())


def owner_text(name: str, platform: Platform, user: str) -> str:
    """Return the owner as the gradebook stores it: "Jane Doe (moodle 1024)".

    The text includes the platform, because two platforms may use the same number.
    """
    return f"{name} ({platform} {user})" if user.isdigit() else name


def read_owner(owner: str) -> tuple[str, str, str]:
    """Return name, platform and number from a text that `owner_text` made; missing parts are ""."""
    found = _OWNER.fullmatch(owner)
    assert found is not None
    return found["name"], found["platform"] or "", found["number"] or ""


def same_number(a: str, b: str) -> bool:
    """Return whether two owners have the same number on the same platform."""
    (_, *of_a), (_, *of_b) = read_owner(a), read_owner(b)
    return of_a == of_b and bool(of_a[1])


@dataclass(frozen=True, kw_only=True)
class Sent:
    """Gradescope's metadata of a submission: students' names, and time in ISO 8601 or ""."""

    names: str
    at: str


def gradescope_metadata(folder: Path) -> dict[str, Sent]:
    """Return Gradescope's metadata by folder name; empty if there is no metadata file."""
    import yaml  # imported late: only a Gradescope download needs it

    sent: dict[str, Sent] = {}
    for path in sorted(folder.iterdir()):
        if not _METADATA.fullmatch(path.name) or path.is_symlink() or not path.is_file():
            continue
        if path.stat().st_size > _MOST_METADATA:
            continue
        try:
            document = yaml.load(path.read_bytes(), Loader=yaml.BaseLoader)  # texts only
        except (yaml.YAMLError, UnicodeError, RecursionError, ValueError):
            continue
        for key, entry in document.items() if isinstance(document, dict) else ():
            if not isinstance(entry, dict):
                continue
            submitters = entry.get(":submitters")
            names = [
                name
                for person in (submitters if isinstance(submitters, list) else ())
                if isinstance(person, dict) and isinstance(name := person.get(":name"), str)
            ]
            at = entry.get(":created_at")
            sent[str(key)] = Sent(
                names=", ".join(filter(None, names)), at=_time(at) if isinstance(at, str) else ""
            )
    return sent


def _time(text: str) -> str:
    """Convert a time written by Ruby to ISO 8601; return "" if the text is not a time."""
    found = _TIME.fullmatch(text)
    if found is None:
        return ""
    day, clock, zone = found.groups()
    try:
        at = datetime.fromisoformat(f"{day}T{clock}{'+00:00' if zone in ('Z', 'UTC') else zone}")
    except ValueError:
        return ""
    return at.isoformat()
