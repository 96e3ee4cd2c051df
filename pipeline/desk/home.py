"""The first page: what is open, and what to open."""

from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

from pipeline.desk.state import Ask
from pipeline.errors import ConfigError

_GRADEBOOK, _CLASS = "gradebook.sqlite", "class.html"


def show_home(ask: Ask) -> Response:
    """Show the rooms that somebody may enter; who has one only is led there."""
    places = [*ask.user.folders, *ask.user.gradebooks]
    if len(places) == 1 and not ask.user.owns:
        room = "student" if ask.user.folders else "grades"
        return RedirectResponse(f"/{room}/0/", status_code=303)
    return ask.page("home", title="cartlab", start=Path.cwd())


def open_place(ask: Ask) -> Response:
    """Open a folder of this computer: a submission, there or not yet, or a grading's output."""
    if not ask.user.owns:
        raise HTTPException(403, "folders of this computer are opened by its owner only")
    typed = ask.text("folder")
    if not typed or not typed.isprintable():
        raise ConfigError("name a folder")
    folder = Path(typed).expanduser().resolve()
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; name the folder that it lies in")
    if (folder / _GRADEBOOK).is_file():
        return _entered(folder, ask.user.gradebooks, room="grades")
    if not folder.parent.is_dir():
        raise ConfigError(f"{folder}: there is no folder {folder.parent} to make it in")
    folder.mkdir(exist_ok=True)
    return _entered(folder, ask.user.folders, room="student")


def open_grades(ask: Ask) -> Response:
    """Show the class page of a grading."""
    folder = ask.grades()
    there = (folder / _CLASS).is_file()
    return ask.page("grades", title=folder.name, there=there)


def _entered(folder: Path, places: list[Path], *, room: str) -> Response:
    if folder not in places:
        places.append(folder)
    return RedirectResponse(f"/{room}/{places.index(folder)}/", status_code=303)
