"""The first page: what is open, and what to open."""

from pathlib import Path

from starlette.responses import RedirectResponse, Response

from pipeline.desk.state import Ask, Found
from pipeline.desk.typed import typed_path
from pipeline.desk.users import User
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.schema import FILE


def show_home(ask: Ask) -> Response:
    """Show the rooms that somebody may enter; who has one only is led there."""
    places = [*ask.user.folders, *ask.user.gradebooks]
    if len(places) == 1 and not ask.user.owns:
        room = "student" if ask.user.folders else "grades"
        return RedirectResponse(f"/{room}/0/", status_code=303)
    return ask.page("home", title="cartlab", start=Path.cwd())


def open_place(ask: Ask) -> Response:
    """Open what somebody named: a folder of this computer, or a database."""
    typed = ask.text("folder")
    if "://" in typed:
        ask.desk.books.book(typed)
        return RedirectResponse(_entered(typed, ask.user.gradebooks, "grades"), status_code=303)
    address = enter(ask.user, typed_path(typed, wanted="name a folder"))
    return RedirectResponse(address, status_code=303)


def enter(user: User, folder: Path) -> str:
    """Open a folder: a submission, there or not yet, or a grading's output; return its address.

    Raises
    ------
    ConfigError : it is no folder, and none can be made there.
    """
    folder = folder.resolve()
    if folder.name == FILE and folder.is_file():
        folder = folder.parent
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; name the folder that it lies in")
    if (folder / FILE).is_file():
        return _entered(folder, user.gradebooks, "grades")
    if not folder.parent.is_dir():
        raise ConfigError(f"{folder}: there is no folder {folder.parent} to make it in")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made ({error.strerror})") from None
    return _entered(folder, user.folders, "student")


def _entered(place: Found, places: list[Found], room: str) -> str:
    if place not in places:
        places.append(place)
    return f"/{room}/{places.index(place)}/"
