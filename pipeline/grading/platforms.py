"""The learning platforms: the names of their downloads, their tables, and their feedback files.

A new platform is one `Platform` in `PLATFORMS`; all that depends on a platform is in this file.

- Canvas: names are those of `lib/content_zipper.rb`. Grades are the CSV of its gradebook, read by
  `lib/gradebook_importer.rb`. It finds students by `ID`, `SIS User ID` or `SIS Login ID`, and the
  assignment by its title, which may be followed by its id in brackets. Feedback files must have the
  names of the downloaded files (`infer_comment_context_from_filename` in
  `app/models/abstract_assignment.rb`); a student sees them under the name of the own upload.
- Moodle: names are those of `mod/assign/classes/downloader.php`; for a group, name and number are
  those of the group. Grades are the offline grading worksheet of one assignment
  (`mod/assign/feedback/offline`), if the participant numbers are known; otherwise the table for
  *Import CSV* of its gradebook. Feedback files are read by
  `mod/assign/feedback/file/importziplib.php`.
- Gradescope: downloads have a folder `submission_77001` for each upload, next to a file
  `submission_metadata.yml`. Grades are the table of its *Download Grades*, and a `results.json` for
  each submission, as an autograder writes it.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

_ATTEMPT = re.compile(r"(?P<stem>.+)-(?P<attempt>\d{1,3})(?P<suffix>(?:\.\w+)?)")
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.\d*)? ?(Z|UTC|[+-]\d\d:?\d\d)")
_METADATA = re.compile(r"(?:submission_)?metadata\.ya?ml")
_MOST_METADATA = 10_000_000  # most bytes of the metadata file
# A participant of Moodle in any language, such as "Participant 1024" or "Teilnehmer/in1024".
_PARTICIPANT = re.compile(r"^(\D+)(\d+)$")
_NO_NUMBER = "anonymous"  # in the place of the number of an account whose name is hidden
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*]')
_LONGEST = 150  # characters of a name
_ID = re.compile(r"(?=.*\d)\S+")  # an id number: no spaces, and at least one digit


@dataclass(frozen=True, kw_only=True)
class Table:
    """The columns of a platform's table.

    The text for a column contains placeholders in braces, which are replaced by the student's
    values; see `export.values_of`. In column names, `{title}` is replaced by the title of the
    assignment.

    Attributes
    ----------
    filled : columns of the platform's own table that receive grades, the points first.
    if_there : columns that receive values only if the table has them.
    kept : other columns to keep; empty: all.
    new : the columns of a table that cartlab makes.
    criterion : heading of a column for each criterion in such a table; "" for no such columns.
    """

    filled: Mapping[str, str]
    if_there: Mapping[str, str] = field(default_factory=dict)
    kept: tuple[str, ...] = ()
    new: Mapping[str, str]
    criterion: str = ""


@dataclass(frozen=True, kw_only=True)
class Platform:
    """What cartlab knows about a learning platform.

    Attributes
    ----------
    downloads : patterns of downloaded names, with the groups of `Upload`. A last group `.+` or `.*`
        takes all remaining characters, line ends too. Such a pattern always matches to the end, so
        it needs no backtracking.
    has_folders : whether its downloads contain folders. If not, somebody unpacked an archive.
    metadata : function that reads its file about a download from the folder.
    is_personal : whether an account number belongs to a student also if a team submitted; otherwise
        it belongs to the team's upload.
    numbers, ids, names : columns that identify the student of a row.
    needed : columns that its tables have; empty: at least one that identifies a student.
    headings : function that returns the own headings of a table in another language by the English
        ones; empty if the table is not the platform's.
    table : its table of grades.
    worksheet : another table, used if the numbers of the accounts are known.
    maximum : column with the maximum grade, which an import does not change.
    maxima : first cell of the row with the maximum grades, or "".
    takes_more : whether it imports points above the maximum.
    ignored : titles with such a word may be skipped by its import.
    has_results : whether it takes a `results.json` for each submission, with a score in each.
    feedback : path of a student's file in the zip of feedback that it takes, with placeholders; ""
        if it takes none.
    feedback_needs : why the path of a student may be unknown, and what to do.
    """

    name: str
    downloads: tuple[re.Pattern[str], ...]
    has_folders: bool = True
    metadata: "Callable[[Path], dict[str, Sent]] | None" = None
    is_personal: bool = False
    numbers: tuple[str, ...]
    ids: tuple[str, ...]
    names: tuple[str, ...]
    needed: tuple[str, ...] = ()
    headings: "Callable[[pd.DataFrame], dict[str, str]]" = lambda table: {}
    table: Table
    worksheet: Table | None = None
    maximum: str = ""
    maxima: str = ""
    takes_more: bool = True
    ignored: re.Pattern[str] | None = None
    has_results: bool = False
    feedback: str = ""
    feedback_needs: str = ""

    @property
    def title(self) -> str:
        """Name of the platform in a sentence."""
        return self.name.capitalize()

    @property
    def is_by_upload(self) -> bool:
        """Whether feedback must have the name of a downloaded file, whose whole team reads it."""
        return "{download}" in self.feedback

    def form(self, *, numbered: bool) -> Table:
        """Return its table, or its worksheet if the numbers of the accounts are known."""
        return self.worksheet if self.worksheet and numbered else self.table

    def feedback_path(self, *, name: str, number: str, download: str) -> str:
        """Return the path of a student's feedback in the zip; "" if a part of it is unknown."""
        person = _plain(name.replace("_", " ")) or "Participant"
        if not (download if self.is_by_upload else number):
            return ""
        return self.feedback.format(person=person, number=number, download=_plain(download))


def _plain(name: str) -> str:
    """Return a name without what a path or a zip gives a meaning to."""
    text = "".join(c if c.isprintable() else " " for c in _NOT_IN_NAMES.sub(" ", name))
    return text[:_LONGEST].strip(" .~")


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
    for platform in reversed([*PLATFORMS.values()]):  # a name of Moodle may look like Canvas' too
        for pattern in platform.downloads:
            if found := pattern.fullmatch(name):
                part = found.groupdict(default="")
                return Upload(
                    platform=platform,
                    owner=part["owner"],
                    user=part["user"],
                    late=bool(part.get("late")),
                    file=part["file"],
                    number=int(part.get("upload", 0)),
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


@dataclass(frozen=True, kw_only=True)
class Account:
    """The account that submitted files; the text of it is kept in the gradebook.

    The text includes the platform, because two platforms may use the same number. Older gradebooks
    contain neither the platform nor the downloaded name.

    Attributes
    ----------
    platform : name of the platform, or "".
    number : number of the account on the platform, or "".
    download : name of the downloaded file, if feedback must have it; or "".
    """

    name: str
    platform: str = ""
    number: str = ""
    download: str = ""

    @classmethod
    def of(cls, uploads: Mapping[Path, Upload], *, name: str) -> "Account":
        """Return the account of downloaded files; `name` is the name to show."""
        upload = next(iter(uploads.values()))
        number = upload.user if upload.user.isdigit() else ""
        download = ""
        if upload.platform.is_by_upload:
            # A folder was an archive that somebody unpacked.
            named = [
                f"{p.name}.zip" if p.is_dir() else p.name for p, u in uploads.items() if u.number
            ]
            download = min(
                named, key=lambda one: (not one.lower().endswith(".zip"), one), default=""
            )
            head, _, tail = download.rpartition("_")
            if tail.startswith("link"):  # Canvas takes such a name for that of a link
                download = f"{head}_file-{tail}"
        return cls(name=name, platform=upload.platform.name, number=number, download=download)

    @classmethod
    def read(cls, text: str) -> "Account":
        """Return the account of a text in the gradebook; missing parts are ""."""
        found = _ACCOUNT.fullmatch(text)
        assert found is not None
        part = found.groupdict(default="")
        return cls(**part | {"number": part["number"].replace(_NO_NUMBER, "")})

    def __str__(self) -> str:
        """Return "Jane Doe (moodle 1024)" or "doejane (canvas 1024: doejane_1024_7_lab.zip)"."""
        more = f": {self.download}" if self.download else ""
        number = f" ({self.platform} {self.number or _NO_NUMBER}{more})"
        known = number if self.number or self.download else ""
        again = Account.read(self.name + known)
        if (again.name, again.number) == (self.name, self.number):
            return self.name + known
        return self.name.replace("(", "[") + known  # a student's name that looks like an account


def same_number(a: str, b: str) -> bool:
    """Return whether two owners have the same number on the same platform."""
    one, other = Account.read(a), Account.read(b)
    return one.number != "" and (one.platform, one.number) == (other.platform, other.number)


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


# ------------------------------------------------------------------ tables

_MAXIMUM = "Maximum Grade"


def read_number(text: str) -> float | None:
    """Read a number from a platform's table, also with a decimal comma; None for other text."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def bare_number(text: str) -> str:
    """Return the number of an account, also of a participant of Moodle in any language."""
    return _PARTICIPANT.sub(r"\2", text)


def _moodle_headings(table: "pd.DataFrame") -> dict[str, str]:
    """Return the headings of a table of Moodle in another language, by the English ones.

    Moodle translates the headings, but their order is always the same: participant, name, columns
    such as id number and email address, status, grade, maximum grade, and last the comment. A table
    from the gradebook is known by the email addresses. Empty if the table is neither.
    """
    cells = [[text.strip() for text in table.iloc[:, i]] for i in range(table.shape[1])]
    if not any(cells):
        return {}
    roles: dict[str, int] = {}
    first = next((i for i, column in enumerate(cells) if _participants(column)), len(cells))
    for i in range(first + 2, len(cells)):
        most = {read_number(text) for text in cells[i]}
        if i - 1 > first + 1 and len(most) == 1 and None not in most:
            roles |= {"Identifier": first, "Grade": i - 1, _MAXIMUM: i}
    if roles:
        roles["Full name"] = first + 1
    last = len(cells) - 1
    if last > roles.get(_MAXIMUM, last) and "-" not in cells[last]:
        roles["Feedback comments"] = last
    end = roles.get("Grade", len(cells))
    for i, column in enumerate(cells[:end]):
        given = [text for text in column if text]
        if i in roles.values() or not given or len(set(given)) < len(given):
            continue
        if all("@" in text for text in given):
            roles.setdefault("Email address", i)
        elif "Email address" not in roles and all(_ID.fullmatch(text) for text in given):
            roles.setdefault("ID number", i)
    if "Identifier" not in roles and "Email address" not in roles:
        return {}
    return {name: str(table.columns[i]) for name, i in roles.items()}


def _participants(column: Sequence[str]) -> bool:
    """Return whether a column has Moodle's participants: one word and a different number each."""
    found = [_PARTICIPANT.fullmatch(text) for text in column]
    if not all(found):
        return False
    words, numbers = zip(*(one.groups() for one in found if one), strict=True)
    return len(set(words)) == 1 and len(set(numbers)) == len(numbers)


PLATFORMS: Mapping[str, Platform] = {
    one.name: one
    for one in (
        Platform(
            name="canvas",
            # `doejane_LATE_1024_77001_lab3.zip` or, with anonymous grading,
            # `LATE_anon_x7Yb2_77001_lab3.zip`. A file that is submitted again is `lab3-1.zip`.
            downloads=(
                re.compile(
                    r"(?P<late>LATE_)?(?P<owner>anon_(?P<user>\w{5}))_(?P<upload>\d+)_(?P<file>.+)",
                    re.DOTALL,
                ),
                re.compile(
                    r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+)_(?P<upload>\d+)_(?P<file>.+)",
                    re.DOTALL,
                ),
                re.compile(
                    r"(?P<owner>.+?)(?P<late>_LATE)?_(?P<user>\d+)_(?P<file>(?:text|link)\.html)",
                    re.DOTALL,
                ),
            ),
            has_folders=False,
            is_personal=True,
            numbers=("ID",),
            ids=("ID", "SIS User ID", "SIS Login ID"),
            names=("Student",),
            needed=("ID", "Student"),
            table=Table(
                filled={"{title}": "{points}"},
                # All columns about the student. The importer wants "Section" to be the last one.
                kept=(
                    "Student", "ID", "SIS User ID", "SIS Login ID", "Integration ID",
                    "Root Account", "Section",
                ),
                new={
                    "Student": "{name_or_id}", "ID": "{number}", "SIS User ID": "{id}",
                    "SIS Login ID": "{id}", "Section": "", "{title}": "{points}",
                },
            ),
            maxima="Points Possible",
            # Canvas takes a column whose heading contains one of these words and "Score", "Points"
            # or "Grade" for its own (`NON_ASSIGNMENT_COLUMN_HEADERS` of its importer).
            ignored=re.compile(r"\b(?:current|final|override)\b", re.IGNORECASE),
            feedback="{download}",
            feedback_needs="the file that was submitted is not known (grade the class again from "
            "the zip of Canvas' Download Submissions)",
        ),
        Platform(
            name="moodle",
            # A folder `Jane Doe_1024_assignsubmission_file_`, or the beginning of a file name.
            downloads=(
                re.compile(
                    r"(?P<owner>.+?)(?:_(?P<user>\d+))?_assignsubmission_(?:file|onlinetext)"
                    r"(?:_(?P<file>.*))?",
                    re.DOTALL,
                ),
            ),
            numbers=("Identifier",),
            ids=("ID number", "Username", "Email address"),
            names=("Full name",),
            headings=_moodle_headings,
            table=Table(
                filled={"{title} (Real)": "{points}"},
                if_there={"Feedback comments": "{comment}"},
                new={
                    "ID number": "{id_or_name}", "{title} (Real)": "{points}",
                    "{title} (Feedback)": "{comment}",
                },
            ),
            worksheet=Table(
                filled={"Grade": "{points}"},
                if_there={"Feedback comments": "{comment}"},
                new={
                    "Identifier": "Participant {number}", "Full name": "{name}",
                    "ID number": "{id}", "Status": "", "Grade": "{points}",
                    "Maximum Grade": "{most}", "Grade can be changed": "Yes",
                    "Last modified (submission)": "-", "Last modified (grade)": "-",
                    "Feedback comments": "{comment}",
                },
            ),
            maximum=_MAXIMUM,
            takes_more=False,
            feedback="{person}_{number}_assignsubmission_file_/feedback.html",
            feedback_needs="the participant number is not known (give Moodle's grading worksheet "
            "with --roster)",
        ),
        Platform(
            name="gradescope",
            downloads=(
                re.compile(r"(?=(?P<file>.+\.\w+)?)(?P<owner>submission_(?P<user>\d+))(?:\.\w+)?"),
            ),
            metadata=gradescope_metadata,
            numbers=("Submission ID",),
            ids=("SID", "Email"),
            names=("Name",),
            table=Table(
                filled={"Total Score": "{points}", "Max Points": "{most}"},
                new={
                    "First Name": "{first_name}", "Last Name": "{last_name}", "SID": "{sid}",
                    "Email": "{email}", "Sections": "", "Total Score": "{points}",
                    "Max Points": "{most}", "Status": "{status}", "Submission ID": "{number}",
                    "Submission Time": "", "Lateness (H:M:S)": "{late}", "View Count": "",
                    "Submission Count": "",
                },
                criterion="{i}: {title} ({points} pts)",
            ),
            has_results=True,
        ),
    )
}  # fmt: skip

_ACCOUNT = re.compile(
    rf"(?P<name>.*?)(?: \((?:(?P<platform>{'|'.join(PLATFORMS)}) )?"
    rf"(?P<number>\d+|{_NO_NUMBER}(?=: ))(?:: (?P<download>.+))?\))?",
    re.DOTALL,
)
