"""The links at the top of every page: the desk, the open places, and the current one."""

from dataclasses import dataclass

from pipeline.desk.gradebooks import Gradebooks
from pipeline.desk.users import Place, User, name_place

_BESIDE = 3  # other open places to which every page has a link; the first page lists all
_OF_FOLDERS = ("student", "bench", "solution")
_WHOLE = {
    "exercises": "Exercises", "rubric": "Rubric", "effects": "Effects", "grading": "Grading",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NavLink:
    """A link at the top of a page.

    Attributes
    ----------
    beside : whether the link leads away from the current place; small screens hide such links.
    """

    address: str
    name: str
    beside: bool = False


def list_links(user: User, path: str, books: Gradebooks) -> list[NavLink]:
    """Return the links that a person sees on the page with this address."""
    room, _, rest = path.strip("/").partition("/")
    shown = rest.partition("/")[0]
    found = [NavLink(address="/", name="Desk")]
    for n, place in _latest(user.folders, shown if room in _OF_FOLDERS else ""):
        is_here = room in _OF_FOLDERS and shown == str(n)
        found.append(NavLink(address=f"/student/{n}/", name=name_place(place), beside=not is_here))
        if is_here and user.may("bench"):
            found.append(NavLink(address=f"/bench/{n}/", name="Bench"))
        if is_here and room == "solution":
            found.append(NavLink(address=f"/solution/{n}/", name="Solution"))
    if room in _WHOLE and user.may(room):
        found.append(NavLink(address=f"/{room}/", name=_WHOLE[room]))
    for n, place in _latest(user.gradebooks, shown if room == "grades" else ""):
        is_here = room == "grades" and shown == str(n)
        waiting = books.n_waiting(place)
        name = name_place(place) + (f" ({waiting} asked)" if waiting else "")
        found.append(NavLink(address=f"/grades/{n}/", name=name, beside=not is_here))
    return found + list_feedback(user)


def list_feedback(user: User) -> list[NavLink]:
    """Return links to the grades of a student."""
    if len(user.grades) == 1:
        return [NavLink(address="/feedback/0/", name="Feedback")]
    return [
        NavLink(
            address=f"/feedback/{n}/",
            name=f"{own.assignment or name_place(own.gradebook)}: feedback",
        )
        for n, own in enumerate(user.grades)
    ]


def _latest(places: list[Place] | list, shown: str) -> list[tuple[int, Place]]:
    """Return the last places opened and the current one, each with its number.

    Parameters
    ----------
    shown : number of the current place, as text.
    """
    last = len(places) - _BESIDE
    return [(n, place) for n, place in enumerate(places) if n >= last or str(n) == shown]
