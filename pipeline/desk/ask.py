"""One request: of whom, for which place, how it is answered; and what outlives requests."""

import re
import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import escape
from starlette.datastructures import FormData, QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from pipeline import __version__
from pipeline.desk.benches import Benches
from pipeline.desk.books import Books
from pipeline.desk.browse import find_root
from pipeline.desk.jobs import Job, Jobs, WorkerPool
from pipeline.desk.rooms import list_rooms
from pipeline.desk.seeing import show_job
from pipeline.desk.users import Place, User, name_place
from pipeline.errors import ConfigError
from pipeline.processes import Failed
from pipeline.resources import TEMPLATES

NOTHING_KNOWN: dict[str, Any] = {
    "kind": None, "format": "", "duration": None, "remarks": [], "unusable": [], "unsure": [],
    "lines": [], "fractions": False, "frequency": None, "needs": [], "hardly": [], "still": {},
}  # fmt: skip
Stamp = tuple[int, int, dict[str, str | int]]  # time, size, columns as stated


@dataclass(frozen=True)
class Said:
    """A line that a page says once.

    Attributes
    ----------
    tone : done, changed (done, but not as it was asked), or refused.
    """

    text: str
    tone: Literal["done", "changed", "refused"] = "done"

    def __str__(self) -> str:
        return self.text


@dataclass(kw_only=True)
class Desk:
    """What outlives a request.

    Attributes
    ----------
    root : the folder in which the person at this computer chooses folders from a list.
    """

    root: Path = field(default_factory=find_root)
    jobs: Jobs = field(default_factory=Jobs)
    workers: WorkerPool = field(default_factory=WorkerPool)
    benches: Benches = field(default_factory=Benches)
    books: Books = field(default_factory=Books)
    said: dict[tuple[str, str], list[Said]] = field(default_factory=dict)
    # The content of each downloaded zip.
    handed: dict[Path, dict[str, list[int]]] = field(default_factory=dict)
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
        for file in self.workers.do("list_files", folder=str(folder)):
            path, columns = folder / file, stated(file)
            info = path.stat()
            stamp = info.st_mtime_ns, info.st_size, columns
            kept = self._looks.get(path)
            if kept is None or kept[0] != stamp:
                kept = self._looks[path] = stamp, self._look(folder, file, columns)
                while len(self._looks) > 5_000:
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
        while sum(map(len, texts.values())) > 32_000_000:  # characters
            texts.popitem(last=False)

    def shown(self, digest: str, *, to: str) -> str | None:
        """Return what a page showed somebody; None where it is not known any more."""
        return self._shown.get(to, {}).get(digest)

    def _look(self, folder: Path, file: str, columns: dict[str, str | int]) -> dict[str, Any]:
        try:
            return self.workers.do("look_at_file", folder=str(folder), file=file, columns=columns)
        except Failed as error:  # what the file did to the process, it did to this row only
            return {**NOTHING_KNOWN, "remarks": [str(error)]}

    def close(self) -> None:
        """End all work; benches are told to stop first."""
        self.benches.close()
        self.jobs.close()
        self.books.close()
        self.workers.close()


@dataclass(frozen=True, kw_only=True)
class Ask:
    """One request: of whom, for what. Its form is checked, something is done, a page comes back."""

    desk: Desk
    user: User
    request: Request
    form: FormData

    @property
    def place(self) -> Place | None:
        """The submission or gradebook of the address; None if it is not one of the user's.

        Of others' places there is no address.
        """
        if self.here.startswith("/feedback/"):  # a grade in a gradebook, of which no more is theirs
            return None
        is_class = self.here.startswith("/grades/")
        places = self.user.gradebooks if is_class else self.user.folders
        number = self.request.path_params.get("n", len(places))
        return places[number] if number < len(places) else None

    def folder(self) -> Path:
        """Return the folder that the address is about: a submission, or the output of a grading.

        Raises
        ------
        ConfigError : it is about a class in a database.
        """
        place = self.place_or_404()
        if isinstance(place, str):
            raise ConfigError("a class in a database is graded and written by cartlab grade")
        return place

    def place_or_404(self) -> Place:
        """Return the place that the address is about, a folder or a database, else refuse."""
        if self.place is None:
            raise HTTPException(404, "you have no access to anything here")
        return self.place

    def require_place(self) -> None:
        """Refuse an address whose folder was moved or deleted, or lies on a lost disk.

        Raises
        ------
        ConfigError : the folder cannot be reached.
        """
        if isinstance(self.place, Path) and not self.place.is_dir():
            shown = self.place if self.user.owns else self.place.name
            raise ConfigError(
                f"{shown}: this folder is not there now; it was moved or deleted, or its disk is "
                "not connected. Bring it back, then reload this page"
            )

    @property
    def job(self) -> Job | None:
        """The last work in the place of the address, as this person may read of it."""
        place = self.place
        if not isinstance(place, Path):
            return None
        return show_job(self.desk.jobs.of(place), self.user, place)

    def start(self, task: str, *, title: str, **given: Any) -> None:
        """Begin a long task in the folder that the address is about."""
        folder = self.folder()
        self.desk.jobs.start(task, title=title, place=folder, folder=str(folder), **given)

    def stop(self, folder: Path) -> None:
        """Have the work in a folder stop; what is done is kept."""
        if job := self.desk.jobs.of(folder):
            job.stop.set()

    @property
    def here(self) -> str:
        """The address of the room that the request is about."""
        return "/".join(self.request.url.path.split("/")[:3]).rstrip("/") + "/"

    def _room(self, place: str = "") -> tuple[str, str]:
        """The room of the address, perhaps with a place on its pages."""
        return self.user.name, self.here + place

    @property
    def sent(self) -> FormData | QueryParams:
        """The form, or what the address of a page asks for."""
        return self.form if self.request.method == "POST" else self.request.query_params

    def text(self, name: str) -> str:
        """Return a field of what was sent as text, "" where it is not there."""
        value = self.sent.get(name)
        return value.replace("\r\n", "\n").strip() if isinstance(value, str) else ""

    def query(self, name: str) -> str:
        """Return what the address asks for by a name, whatever form was sent to it."""
        return self.request.query_params.get(name, "")

    def page(self, template: str, *, status: int = 200, **context: Any) -> Response:
        """Return a page, with the work that is under way in its place."""
        folder = self.place if isinstance(self.place, Path) else None
        everywhere = {
            "user": self.user,
            "path": self.request.url.path,
            "here": self.here,
            "rooms": list_rooms(self.user, self.request.url.path, self.desk.books),
            "version": __version__,
            "folder": folder,
            "job": self.job,
            "said": lambda place="": self.desk.said.pop(self._room(place), []),  # once
        }
        text = _environment().get_template(f"{template}.html.j2").render(everywhere | context)
        if prefix := self.request.scope.get("prefix"):
            text = _ADDRESS.sub(lambda found: f'{found[1]}="{escape(prefix)}/', text)
        return HTMLResponse(self.user.told(text), status_code=status)

    def go(self, to: str) -> Response:
        """Return what has htmx open another page; a proxy adds its prefix to plain ways on only."""
        return Response(headers={"HX-Redirect": self.request.scope.get("prefix", "") + to})

    def back(self, to: str, *said: str | Said, place: str = "") -> Response:
        """Return to a page, which says this once: at its head, or at a place that it has."""
        if said:
            lines = [Said(one) if isinstance(one, str) else one for one in said]
            self.desk.said.setdefault(self._room(place), []).extend(lines)
        return RedirectResponse(to, status_code=303)


# An address in a page that we wrote. Texts of others have no quotation marks there.
_ADDRESS = re.compile(
    r'\b(href|src|action|formaction|hx-get|hx-post|data-events|data-page)="/(?!/)'
)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES / "desk"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["called"] = name_place
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
