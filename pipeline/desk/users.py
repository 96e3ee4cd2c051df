"""Who may see what: the person at this computer sees everything, others see what a file lists."""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, ValidationError

from pipeline.desk.jobs import Job, WorkerPool
from pipeline.errors import ConfigError
from pipeline.grading.rubric_file import load_rubric
from pipeline.processes import Failed
from pipeline.submission.load import NAME
from pipeline.submission.models import TomlTable
from pipeline.submission.toml import explain, parse_toml, read_text

Place = Path | str  # a folder, or the address of a database
Role = Literal["owner", "student", "ta", "instructor"]
See = Literal["report", "check"]

# The rooms that each role may enter, by the first part of their addresses. In them, the owner may
# open everything on this computer, others only what the list of users gives them.
_ALL = frozenset({"", "static"})
_ROOMS: dict[Role, frozenset[str]] = {
    "student": _ALL | {"student", "feedback"},
    "ta": _ALL | {"grades"},
    "instructor": _ALL
    | {"student", "grades", "solution", "effects", "exercises", "rubric", "bench"},
}
_ROOMS["owner"] = _ROOMS["instructor"] | {"open", "grading"}
_ROOM_OF = {"folders": "student", "gradebooks": "grades", "workshop": "exercises", "ports": "bench",
            "grades": "feedback"}  # fmt: skip
_NEEDS = {"exercises": "workshop", "rubric": "workshop", "bench": "ports"}


@dataclass(frozen=True, kw_only=True)
class OwnGrade:
    """The place of a student's own grade.

    Attributes
    ----------
    gradebook : the output folder of a grading, or the address of a database.
    submission : exact name of the submission in the gradebook.
    assignment : assignment of the class list, needed if a database holds several; "" for a folder.
    """

    gradebook: Place
    submission: str
    assignment: str = ""


@dataclass(kw_only=True)
class User:
    """A person at the desk.

    Attributes
    ----------
    folders : the submissions that they may see; a URL names one by its index. An owner's list grows
        when they open a folder.
    gradebooks : the output folders of gradings, or addresses of databases, that they may see.
    grades : their own grades, if they are a student.
    workshop : the folder in which they make exercises and rubrics; an owner may use any.
    ports : the benches at which they may record; an owner may use any.
    rubric : rubric of a student's lab; the check uses its tolerances.
    see : what this rubric lets them see; None if their submission decides.
    """

    name: str
    role: Role
    folders: list[Path] = field(default_factory=list)
    gradebooks: list[Place] = field(default_factory=list)
    grades: tuple[OwnGrade, ...] = ()
    workshop: Path | None = None
    ports: tuple[str, ...] = ()
    rubric: Path | None = None
    see: See | None = None

    def may(self, room: str) -> bool:
        """Return whether they may enter a room; their lists decide which places they see there."""
        needed = _NEEDS.get(room)
        listed = needed is None or self.owns or bool(getattr(self, needed))
        return room in _ROOMS[self.role] and listed

    @property
    def sees_places(self) -> bool:
        """Whether they may see the paths of folders on this computer."""
        return self.role not in ("student", "ta")

    def name_places(self, message: str) -> str:
        """Return a message in which their places have only names if they may not see paths."""
        if self.sees_places:
            return message
        listed = (*self.folders, *self.gradebooks, *(own.gradebook for own in self.grades))
        for place in (*listed, *filter(None, (self.rubric,))):
            for path in {place, place.resolve()} if isinstance(place, Path) else ():
                message = message.replace(str(path), name_place(path))
        return message

    @property
    def owns(self) -> bool:
        """Whether they may open everything on this computer that the system allows."""
        return self.role == "owner"


_HEADER = r"^[A-Za-z0-9-]+$"


class Proxy(TomlTable):
    """The reverse proxy of a lab server, which identifies each person."""

    address: Annotated[str, Field(min_length=1)]  # only the proxy may connect
    header: Annotated[str, Field(pattern=_HEADER)]  # states the person's name
    secret_header: Annotated[str, Field(pattern=_HEADER)]  # states the secret
    # Known only to the proxy and the desk.
    secret: Annotated[str, Field(pattern=r"^[!-~]{24,200}$")]
    # The address that browsers use; they write it in lower case.
    site: Annotated[
        str, StringConstraints(to_lower=True), Field(pattern=r"^(?i:https?)://[^/\s]+$")
    ]


class ListedGrade(TomlTable):
    """One grade of a student."""

    gradebook: Annotated[str, Field(min_length=1)]
    submission: Annotated[str, Field(min_length=1)]
    assignment: str = ""


class Listed(TomlTable):
    """One user in the list."""

    name: Annotated[str, Field(min_length=1)]
    role: Literal["student", "ta", "instructor"]
    folders: tuple[str, ...] = ()
    gradebooks: tuple[str, ...] = ()
    grades: tuple[ListedGrade, ...] = ()
    workshop: str = ""
    ports: tuple[str, ...] = ()
    rubric: str = ""  # rubric of a student's lab; its [students] decides what they see


class Users(TomlTable):
    """The list of users, which `--users` names."""

    proxy: Proxy
    users: tuple[Listed, ...]


def read_users(path: Path) -> tuple[Proxy, dict[str, User]]:
    """Read the list of users; its folders are relative to the file's own folder.

    Raises
    ------
    ConfigError : the list is not valid; the message names the file, the key and the mistake.
    """
    text = read_text(path, where=str(path), limit=1_000_000, error=ConfigError)
    document = parse_toml(text, where=str(path), error=ConfigError)
    try:
        found = Users.model_validate(document)
    except ValidationError as error:
        first = explain(error.errors()[0], document, root=Users)
        raise ConfigError(f"{path}: {first}") from None
    root = path.resolve().parent
    if wrong := next(_find_wrong(found, root), None):
        raise ConfigError(f"{path}: {wrong}")
    if os.name == "posix":
        _refuse_open_to_all(path)
    return found.proxy, {
        user.name: User(
            name=user.name,
            role=user.role,
            folders=[root / folder for folder in user.folders],
            gradebooks=[_read_place(one, root) for one in user.gradebooks],
            grades=tuple(
                OwnGrade(
                    gradebook=_read_place(own.gradebook, root),
                    submission=own.submission,
                    assignment=own.assignment,
                )
                for own in user.grades
            ),
            workshop=(root / user.workshop).resolve() if user.workshop else None,
            ports=user.ports,
            rubric=root / user.rubric if user.rubric else None,
            see=load_rubric(root / user.rubric).students.see if user.rubric else None,
        )
        for user in found.users
    }


def _read_place(typed: str, root: Path) -> Place:
    return typed if "://" in typed else root / typed


def _refuse_open_to_all(path: Path) -> None:
    """Refuse a list that everybody on the computer can read, change or replace."""
    folder = path.resolve().parent
    mode, above = path.stat().st_mode, folder.stat().st_mode
    everybody = "everybody on this computer can"
    if mode & stat.S_IROTH:
        raise ConfigError(
            f"{path}: {everybody} read it, including the proxy's secret: run chmod o-r on it"
        )
    if mode & stat.S_IWOTH:
        raise ConfigError(f"{path}: {everybody} write it and take any role: run chmod o-w on it")
    # In a folder with the sticky bit, such as /tmp, only the owner can replace the file.
    if above & stat.S_IWOTH and not above & stat.S_ISVTX:
        raise ConfigError(f"{folder}: {everybody} replace {path.name} there: run chmod o-w on it")


def _find_wrong(found: Users, root: Path) -> Iterator[str]:
    """Yield a message for each statement that cannot be right."""
    proxy, names = found.proxy, [user.name for user in found.users]
    try:
        ip_address(proxy.address)
    except ValueError:
        yield f"proxy.address: expected an address such as 127.0.0.1, found {proxy.address!r}"
    if proxy.header.lower() == proxy.secret_header.lower():
        yield "proxy.secret_header: expected a header other than that of the name"
    for user in found.users:
        where = f"users: {user.name!r}"
        if names.count(user.name) > 1:
            yield f"{where} is listed twice"
        # A proxy may write names in UTF-8 or Latin-1; no name may be mistaken for another one.
        if (other := user.name.encode().decode("latin-1")) != user.name and other in names:
            yield f"{where} in UTF-8 equals {other!r} in Latin-1, which is also listed"
        for key, room in _ROOM_OF.items():
            if getattr(user, key) and room not in _ROOMS[user.role]:
                yield f"{where}: a {user.role} cannot have {key}; remove it, or change the role"
        if user.rubric and user.role != "student":
            yield f"{where}: a {user.role} cannot have a rubric; remove it, or change the role"
        books = [own.gradebook for own in user.grades]
        for place in (*user.folders, *user.gradebooks, *books, user.workshop):
            if "://" not in place and not (root / place).is_dir():
                yield f"{where}: the folder {root / place} does not exist"
        for own in user.grades:
            if "://" in own.gradebook and not own.assignment:
                yield (
                    f"{where}: a database may hold several classes; add assignment = the name of "
                    "the rubric's file, without .toml"
                )


def name_place(place: Place) -> str:
    """Return a name for a place; for a database only its own name, never the user or password."""
    if isinstance(place, str):
        try:
            parts = urlsplit(place)
        except ValueError:  # an unclosed bracket; opening the database reports the error
            return place.partition("://")[0]
        return parts.path.strip("/") or parts.hostname or parts.scheme
    return place.name or str(place)


# ---------------------------------------------------------------------------------- report or check

# The parts of the student's room that show no computed number. Any part that is not in this list is
# refused.
_SHOWS_NONE = frozenset(
    {"", "files", "fill", "aside", "save", "experiments", "check", "hand-in", "hand-in.zip",
     "events", "stop"}
)  # fmt: skip
_TELLS_NONE = frozenset({"check_numbers"})  # tasks whose stages and result show no computed number
REFUSED = (
    "in this lab you find the numbers yourself: the report is for your TA. "
    "The check shows which of your numbers disagree with your recordings"
)


class Visibility:
    """What students see in their rooms; a worker reads each submission, again after a change."""

    def __init__(self, workers: WorkerPool) -> None:
        self._workers = workers
        self._known: dict[Path, tuple[tuple[int, int], str]] = {}

    def sees_check(self, user: User, folder: Place | None) -> bool:
        """Return whether the room of a folder shows the check instead of the report.

        On a lab server, the rubric in the list of users decides. If the list has no rubric,
        `[students] see` in submission.toml decides. Students can change this file, so this is only
        an agreement.
        """
        if user.role == "instructor" or not isinstance(folder, Path):
            return False
        if user.see is not None:
            return user.see == "check"
        try:
            info = (folder / NAME).stat()
        except OSError:  # the page says what is wrong
            return False
        stamp = info.st_mtime_ns, info.st_size
        known = self._known.get(folder)
        if known is None or known[0] != stamp:
            try:
                sees = self._workers.do("students_see", folder=str(folder))
            except Failed:  # the page says what is wrong
                sees = ""
            known = self._known[folder] = stamp, sees
        return known[1] == "check"

    def is_refused(self, path: str, user: User, folder: Place | None) -> bool:
        """Return whether to refuse an address that could show numbers the student must find."""
        parts = path.split("/")
        room, part = parts[1], parts[3] if len(parts) > 3 else ""
        return room == "student" and part not in _SHOWS_NONE and self.sees_check(user, folder)

    def show_job(self, job: Job | None, user: User, folder: Path) -> Job | None:
        """Return the job in a folder as the person may see it.

        The job's stages are hidden if they could show numbers, because another person may be making
        a report in the folder.
        """
        if job is None or job.task[0] in _TELLS_NONE or not self.sees_check(user, folder):
            return job
        return job.without_message()
