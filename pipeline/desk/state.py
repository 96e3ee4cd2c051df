"""What every page of the desk is made with: who asks, for which place, and what is under way."""

import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.datastructures import FormData
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from pipeline import __version__
from pipeline.desk.benches import Sessions
from pipeline.desk.books import Books
from pipeline.desk.jobs import Failed, Hand, Jobs
from pipeline.desk.users import Place, User, place_name
from pipeline.resources import TEMPLATES

_MOST_SHOWN = 32_000_000  # characters of the texts that pages of one person were filled in from
_MOST_LOOKS = 5_000  # files of which is kept what they are
NOTHING_KNOWN: dict[str, Any] = {
    "kind": None, "format": "", "duration": None, "remarks": [], "unsure": [], "lines": [],
    "fractions": False,
}  # fmt: skip
Stamp = tuple[int, int, dict[str, str | int]]  # time, size, columns as stated
Found = TypeVar("Found", Path, Place)


@dataclass(kw_only=True)
class Desk:
    """What outlives a request."""

    jobs: Jobs = field(default_factory=Jobs)
    hand: Hand = field(default_factory=Hand)
    benches: Sessions = field(default_factory=Sessions)
    books: Books = field(default_factory=Books)
    said: dict[tuple[str, str], list[str]] = field(default_factory=dict)
    _shown: dict[str, OrderedDict[str, str]] = field(default_factory=dict)
    _looks: OrderedDict[Path, tuple[Stamp, dict[str, Any]]] = field(default_factory=OrderedDict)

    def looks(
        self, folder: Path, stated: Callable[[str], dict[str, str | int]]
    ) -> dict[str, dict[str, Any]]:
        """Return what the data files of a submission are, by name; each is looked at once.

        Parameters
        ----------
        stated : which column of a file is what.
        """
        found = {}
        for file in self.hand.do("files", folder=str(folder)):
            path, columns = folder / file, stated(file)
            info = path.stat()
            stamp = info.st_mtime_ns, info.st_size, columns
            kept = self._looks.get(path)
            if kept is None or kept[0] != stamp:
                kept = self._looks[path] = stamp, self._look(folder, file, columns)
                while len(self._looks) > _MOST_LOOKS:
                    self._looks.popitem(last=False)
            found[file] = kept[1]
        return found

    def keep_shown(self, text: str, *, digest: str, to: str) -> None:
        """Keep what a page shows, by which a form that comes back tells what was typed in it.

        It is kept for every person: while one fills in a form, a class saves theirs.
        """
        texts = self._shown.setdefault(to, OrderedDict())
        texts[digest] = text
        texts.move_to_end(digest)
        while sum(map(len, texts.values())) > _MOST_SHOWN:
            texts.popitem(last=False)

    def shown(self, digest: str, *, to: str) -> str | None:
        """Return what a page showed somebody; None where it is not known any more."""
        return self._shown.get(to, {}).get(digest)

    def _look(self, folder: Path, file: str, columns: dict[str, str | int]) -> dict[str, Any]:
        try:
            return self.hand.do("look", folder=str(folder), file=file, columns=columns)
        except Failed as error:  # what the file did to the process, it did to this row only
            return {**NOTHING_KNOWN, "remarks": [str(error)]}

    def close(self) -> None:
        """End all work; benches are told to stop first."""
        self.benches.close()
        self.jobs.close()
        self.books.close()
        self.hand.close()


@dataclass(frozen=True, kw_only=True)
class Ask:
    """One request: of whom, for what."""

    desk: Desk
    user: User
    request: Request
    form: FormData

    def folder(self) -> Path:
        """Return the submission that the address is about; of others' there is no address."""
        return self._place(self.user.folders)

    def grades(self) -> Place:
        """Return the gradebook that the address is about: the folder it is in, or a database."""
        return self._place(self.user.gradebooks)

    def _place(self, places: list[Found]) -> Found:
        number = self.request.path_params["n"]
        if number >= len(places):
            raise HTTPException(404, "there is nothing here that is yours to see")
        return places[number]

    @property
    def here(self) -> str:
        """The address of the room that the request is about."""
        return "/".join(self.request.url.path.split("/")[:3]).rstrip("/") + "/"

    @property
    def _room(self) -> tuple[str, str]:
        """Whose room the address is in, and which."""
        return self.user.name, self.here

    def text(self, name: str) -> str:
        """Return a field of the form as text, "" where it is not there."""
        value = self.form.get(name)
        return value.replace("\r\n", "\n").strip() if isinstance(value, str) else ""

    def page(self, template: str, *, status: int = 200, **context: Any) -> Response:
        """Return a page."""
        text = (
            _environment()
            .get_template(f"{template}.html.j2")
            .render(
                user=self.user,
                path=self.request.url.path,
                here=self.here,
                rooms=rooms(self.user),
                version=__version__,
                **context,
            )
        )
        return HTMLResponse(self.user.told(text), status_code=status)

    def back(self, to: str, *said: str) -> Response:
        """Return to a page, which says this once."""
        if said:
            self.desk.said.setdefault(self._room, []).extend(said)
        return RedirectResponse(to, status_code=303)

    def told(self) -> list[str]:
        """Return what is to be said on this page, once."""
        return self.desk.said.pop(self._room, [])


def rooms(user: User) -> list[tuple[str, str]]:
    """Return the address and the name of every room that somebody may enter."""
    found = [("/", "Desk")]
    found += [(f"/student/{n}/", place_name(p)) for n, p in enumerate(user.folders)]
    whole = {"exercises": "Exercises", "rubric": "Rubric", "effects": "Effects"}
    found += [(f"/{room}/", name) for room, name in whole.items() if user.may(room)]
    if user.may("bench"):
        found += [(f"/bench/{n}/", f"{place_name(p)}: bench") for n, p in enumerate(user.folders)]
    found += [(f"/grades/{n}/", place_name(p)) for n, p in enumerate(user.gradebooks)]
    return found


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES / "desk"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["called"] = place_name
    # Whatever is cached of an earlier version of a style sheet or script is not asked for again.
    environment.globals["fresh"] = secrets.token_hex(4)
    return environment


def prepare_pages() -> None:
    """Compile all templates: a fifth of the first look at a large class, else."""
    for name in _environment().list_templates(extensions=["j2"]):
        _environment().get_template(name)


def plain_error(ask: Ask, text: str, *, status: int) -> Response:
    """Return a page that says what is wrong."""
    return ask.page("wrong", status=status, title="That did not work", text=text)
