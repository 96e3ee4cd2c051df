"""Who handed in a file, and whether late, by the names learning platforms give their downloads.

Canvas: `doejane_LATE_1024_77001_lab3.zip`, a resubmitted file `lab3-1.zip`. Moodle: a folder, or
the beginning of a file's name, `Jane Doe_1024_assignsubmission_file_`. Gradescope:
`submission_77001` beside `submission_metadata.yml`.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Platform = Literal["canvas", "moodle", "gradescope"]

_CANVAS = re.compile(
    r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+|(?<=anon_)\w{5})_(?P<upload>\d+)_(?P<file>.+)"
)
_CANVAS_TEXT = re.compile(r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+)_(?P<file>\w+\.html?)")
_MOODLE = re.compile(
    r"(?P<owner>.+?)_(?P<user>\d+)_assignsubmission_(?:file|onlinetext)(?:_(?P<file>.*))?"
)
_GRADESCOPE = re.compile(r"(?P<owner>submission_\d+)(?P<file>\.\w+)?")
_ATTEMPT = re.compile(r"(?P<stem>.+)-(?P<attempt>\d{1,3})(?P<suffix>(?:\.\w+)?)")
_METADATA = re.compile(r"(?:submission_)?metadata\.ya?ml")
_MOST_METADATA = 10_000_000  # bytes


@dataclass(frozen=True, kw_only=True)
class Upload:
    """What a name says: whose, late or not, and the file's name as the student had it.

    `order` grows from an attempt to the next one.
    """

    platform: Platform
    owner: str
    user: str
    late: bool = False
    file: str = ""
    order: tuple[int, int] = field(default=(0, 0))


def parse_name(name: str) -> Upload | None:
    """Return what the name of a downloaded file or folder says; None where no platform made it."""
    if found := _MOODLE.fullmatch(name):
        return Upload(
            platform="moodle", owner=found["owner"], user=found["user"], file=found["file"] or ""
        )
    if found := _GRADESCOPE.fullmatch(name):
        user = found["owner"].removeprefix("submission_")
        file = name if found["file"] else ""
        return Upload(platform="gradescope", owner=found["owner"], user=user, file=file)
    if found := _CANVAS.fullmatch(name) or _CANVAS_TEXT.fullmatch(name):
        upload = int(found["upload"]) if "upload" in found.groupdict() else 0
        attempt = _ATTEMPT.fullmatch(found["file"])
        return Upload(
            platform="canvas",
            owner=found["owner"],
            user=found["user"],
            late=found["late"] is not None,
            file=found["file"],
            order=(int(attempt["attempt"]) if attempt else 0, upload),
        )
    return None


def current(uploads: Mapping[Path, Upload]) -> list[Path]:
    """Return the files of one student without those that a later attempt replaces.

    Canvas appends `-1`, `-2` to the name of a file that is handed in again.
    """
    newest: dict[str, Path] = {}
    names = {upload.file for upload in uploads.values()}
    for path, upload in sorted(uploads.items(), key=lambda item: item[1].order):
        attempt = _ATTEMPT.fullmatch(upload.file)
        first = f"{attempt['stem']}{attempt['suffix']}" if attempt else upload.file
        # `run-2.csv` is a second attempt only where `run.csv` is there as well.
        newest[first if first in names else upload.file] = path
    return sorted(newest.values())


def gradescope_owners(folder: Path) -> dict[str, str]:
    """Return the students' names by `submission_…`, from the metadata file if there is one."""
    import yaml  # only a Gradescope download needs it

    owners: dict[str, str] = {}
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
            submitters = entry.get(":submitters") if isinstance(entry, dict) else None
            names = [
                str(person[":name"])
                for person in (submitters if isinstance(submitters, list) else ())
                if isinstance(person, dict) and person.get(":name")
            ]
            if names:
                owners[str(key)] = ", ".join(names)
    return owners
