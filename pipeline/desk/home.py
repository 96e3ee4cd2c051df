"""The first page: what a person can do, the state of what is open, and folders to choose from."""

from pathlib import Path
from typing import Any

from starlette.responses import RedirectResponse, Response

from pipeline.desk.browse import MOST, list_folders
from pipeline.desk.form_input import read_path
from pipeline.desk.jobs import Job
from pipeline.desk.last_report import find_state, read_findings
from pipeline.desk.navigation import list_feedback
from pipeline.desk.page_request import PageRequest
from pipeline.desk.users import Place, User, name_place
from pipeline.errors import ConfigError, PipelineError
from pipeline.experiments.plan import NAME as PLAN
from pipeline.grading.gradebook.database import FILE
from pipeline.submission.load import file_problem

_MADE = 3  # exercises listed on the first page
# The rooms for which a folder can be chosen.
_ROOMS = ("student", "bench", "solution")


def show_home(ask: PageRequest) -> Response:
    """Show what a person can do here; a person with only one place is taken to it."""
    user = ask.user
    places = {"student": user.folders, "grades": user.gradebooks, "feedback": user.grades}
    rooms = [room for room, listed in places.items() for _ in listed]
    if len(rooms) == 1 and not user.owns:
        return RedirectResponse(f"/{rooms[0]}/0/", status_code=303)
    return ask.page(
        "home",
        title="cartlab",
        submissions=[_describe_submission(ask, n, p) for n, p in enumerate(user.folders)],
        classes=[_describe_class(ask, n, place) for n, place in enumerate(user.gradebooks)],
        made=_list_made(ask),
        feedback=list_feedback(user),
        start=ask.desk.root,
        to="",
    )


def show_folders(ask: PageRequest) -> Response:
    """Show the list of folders to choose from."""
    to, folders = ask.text("to"), list_folders(ask.desk.root, ask.text("in"))
    return ask.page(
        "folders",
        title="Choose a folder",
        folders=folders,
        to=to if to in _ROOMS else "",
        start=folders.here.path,
        most=MOST,
    )


def open_place(ask: PageRequest) -> Response:
    """Open what a person chose or typed: a folder on this computer, or a database."""
    typed, to = ask.text("folder"), ask.text("to")
    if "://" in typed:
        ask.desk.gradebooks.gradebook(typed)
        return RedirectResponse(_add_place(typed, ask.user.gradebooks, "grades"), status_code=303)
    address = enter(ask.user, read_path(typed, wanted="enter a folder"))
    if to in _ROOMS and address.startswith("/student/"):
        address = address.replace("student", to, 1)
    elif to == "compare" and address.startswith("/student/"):
        address += to
    return RedirectResponse(address, status_code=303)


def enter(user: User, folder: Path) -> str:
    """Open a folder as a submission or as the output of a grading; return its address.

    A folder that does not exist is created, as an empty submission.

    Raises
    ------
    ConfigError : `folder` is a file, or it cannot be created.
    """
    folder = folder.resolve()
    if folder.name == FILE and folder.is_file():
        folder = folder.parent
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: this is a file; enter its folder")
    if (folder / FILE).is_file():
        return _add_place(folder, user.gradebooks, "grades")
    if not folder.parent.is_dir():
        raise ConfigError(f"{folder}: the folder {folder.parent} does not exist")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be created ({error.strerror})") from None
    return _add_place(folder, user.folders, "student")


def _add_place(place: Place, places: list[Any], room: str) -> str:
    if place not in places:
        places.append(place)
    return f"/{room}/{places.index(place)}/"


def _list_made(ask: PageRequest) -> list[Job]:
    """Return the jobs of the last exercises, finished or not, that the person may see."""
    shop, jobs = ask.user.workshop, ask.desk.jobs.list_of("make_exercises")
    seen = [job for job in jobs if ask.user.owns or (shop and job.place.is_relative_to(shop))]
    return seen[:_MADE]


def _describe_submission(ask: PageRequest, n: int, folder: Path) -> dict[str, Any]:
    """Return the state of a submission: its files, report, recordings and solution.

    `report` is the state of the report (see `last_report.find_state`), and `doubt` is what the
    report says against its numbers.
    """
    session, data = ask.desk.benches.of(folder), folder / "data"
    try:
        # A link is not followed, because it may lead to a whole disk.
        files = 0 if data.is_symlink() else sum(1 for path in data.rglob("*") if path.is_file())
        report = find_state(folder) if folder.is_dir() else "unreadable"
        status = read_findings(folder)["status"]
    except OSError:  # the desk may not read it, or its disk is not connected
        files, report, status = 0, "unreadable", None
    return {
        "n": n,
        "name": name_place(folder),
        "folder": folder,
        "files": files,
        "report": report,
        "doubt": "" if status is None or status.is_fine else status.words,
        "is_recording": session is not None and not session.ended.is_set(),
        "has_plan": file_problem(folder, PLAN) is None,
        "has_solution": file_problem(folder, "solution/solution.html") is None,
    }


def _describe_class(ask: PageRequest, n: int, place: Place) -> dict[str, Any]:
    """Return the state of a class: whether work is running there, and how many were reviewed.

    A class that cannot be read, or is not graded yet, has no teams.
    """
    try:
        teams = ask.desk.gradebooks.of(place).now.entries
    except (PipelineError, OSError):
        teams = ()
    job = ask.desk.jobs.of(place) if isinstance(place, Path) else None
    return {
        "n": n,
        "name": name_place(place),
        "place": place,
        "is_running": job is not None and not job.over,
        "teams": len(teams),
        "seen": sum(1 for team in teams if team.reviewed_by),
    }
