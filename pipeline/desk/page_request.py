"""One request to the desk, and the data that the desk keeps between requests."""

import re
import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from starlette.datastructures import FormData, QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from pipeline import __version__
from pipeline.desk.benches import Benches
from pipeline.desk.browse import find_root
from pipeline.desk.gradebooks import ClassView, Gradebooks
from pipeline.desk.jobs import Job, Jobs, WorkerPool
from pipeline.desk.navigation import list_links
from pipeline.desk.parts import leave_out_parts
from pipeline.desk.users import Place, User, Visibility, name_place
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.words import points_text
from pipeline.processes import Failed
from pipeline.resources import TEMPLATES
from pipeline.words.text import breakable

NOTHING_KNOWN: dict[str, Any] = {
    "kind": None, "format": "", "duration": None, "remarks": [], "unusable": [], "unsure": [],
    "lines": [], "fractions": False, "frequency": None, "needs": [], "hardly": [], "still": {},
}  # fmt: skip
# Time of change and size of a data file, and its columns as stated in submission.toml.
Stamp = tuple[int, int, dict[str, str | int]]


@dataclass(frozen=True)
class Message:
    """A message that a page shows once.

    Attributes
    ----------
    tone : `done`, `changed` (done, but not exactly as asked) or `refused`.
    """

    text: str
    tone: Literal["done", "changed", "refused"] = "done"

    def __str__(self) -> str:
        return self.text


@dataclass(kw_only=True)
class Desk:
    """The data that the desk keeps between requests.

    Attributes
    ----------
    root : the top folder of the list in which the person at this computer chooses a folder.
    messages : messages still to be shown, by person and address.
    """

    root: Path = field(default_factory=find_root)
    jobs: Jobs = field(default_factory=Jobs)
    workers: WorkerPool = field(default_factory=WorkerPool)
    benches: Benches = field(default_factory=Benches)
    gradebooks: Gradebooks = field(default_factory=Gradebooks)
    messages: dict[tuple[str, str], list[Message]] = field(default_factory=dict)
    visibility: Visibility = field(init=False)
    # By folder: the files that the last downloaded zip contained, with their time and size.
    handed: dict[Path, dict[str, list[int]]] = field(default_factory=dict)
    _shown: dict[str, OrderedDict[str, str]] = field(default_factory=dict)
    _described: OrderedDict[Path, tuple[Stamp, dict[str, Any]]] = field(default_factory=OrderedDict)

    def __post_init__(self) -> None:
        self.visibility = Visibility(self.workers)

    def describe_files(
        self, folder: Path, stated: Callable[[str], dict[str, str | int]]
    ) -> dict[str, dict[str, Any]]:
        """Return what each data file of a submission contains, by name; reread only changed files.

        Parameters
        ----------
        stated : function that returns the columns that `submission.toml` states for a file.
        """
        found = {}
        for file in self.workers.do("list_files", folder=str(folder)):
            path, columns = folder / file, stated(file)
            info = path.stat()
            stamp = info.st_mtime_ns, info.st_size, columns
            cached = self._described.get(path)
            if cached is None or cached[0] != stamp:
                cached = self._described[path] = stamp, self._describe_file(folder, file, columns)
                while len(self._described) > 5_000:
                    self._described.popitem(last=False)
            found[file] = cached[1]
        return found

    def keep_shown(self, text: str, *, digest: str, to: str) -> None:
        """Keep the text that a page shows, to find later which values of its form were changed.

        Each person has a separate store, so that texts of other people cannot displace theirs.

        Parameters
        ----------
        digest : identifies the text.
        to : name of the person.
        """
        texts = self._shown.setdefault(to, OrderedDict())
        texts[digest] = text
        texts.move_to_end(digest)
        while sum(map(len, texts.values())) > 32_000_000:  # characters
            texts.popitem(last=False)

    def shown(self, digest: str, *, to: str) -> str | None:
        """Return a text that a page showed; None if it is no longer kept."""
        return self._shown.get(to, {}).get(digest)

    def _describe_file(
        self, folder: Path, file: str, columns: dict[str, str | int]
    ) -> dict[str, Any]:
        try:
            return self.workers.do("describe_file", folder=str(folder), file=file, columns=columns)
        except Failed as error:  # the file stopped its process; only its own row is affected
            return {**NOTHING_KNOWN, "remarks": [str(error)]}

    def close(self) -> None:
        """End all work; recordings on benches are stopped first."""
        self.benches.close()
        self.jobs.close()
        self.gradebooks.close()
        self.workers.close()


@dataclass(frozen=True, kw_only=True)
class PageRequest:
    """One request: who asks, about which place, with which form."""

    desk: Desk
    user: User
    request: Request
    form: FormData

    @property
    def place(self) -> Place | None:
        """The submission or gradebook that the URL names; None if the user has no such place.

        The number in a URL counts only the user's own places, so no URL leads to another person's
        place.
        """
        # A student may see only their own grade, not the gradebook.
        if self.here.startswith("/feedback/"):
            return None
        is_class = self.here.startswith("/grades/")
        places = self.user.gradebooks if is_class else self.user.folders
        number = self.request.path_params.get("n", len(places))
        return places[number] if number < len(places) else None

    def folder(self) -> Path:
        """Return the folder that the URL names: a submission, or the output of a grading.

        Raises
        ------
        ConfigError : the URL names a class in a database.
        """
        place = self.place_or_404()
        if isinstance(place, str):
            raise ConfigError("a class in a database is graded and written by cartlab grade")
        return place

    def place_or_404(self) -> Place:
        """Return the folder or database that the URL names; refuse a request without one."""
        if self.place is None:
            raise HTTPException(404, "you have no access to anything here")
        return self.place

    @property
    def gradebook(self) -> Gradebook:
        """The gradebook that the URL names."""
        return self.desk.gradebooks.gradebook(self.place_or_404())

    @property
    def class_view(self) -> ClassView:
        """The class that the URL names, in its current state."""
        return self.desk.gradebooks.of(self.place_or_404())

    @property
    def team(self) -> Entry:
        """The team that the URL names."""
        return self.class_view.team(self.query("of"))

    @property
    def signature(self) -> str:
        """The name with which a person's changes are signed; "" if it is not known yet."""
        return self.user.name or self.desk.gradebooks.signed

    def sign(self) -> str:
        """Return the name that signs a change: from the proxy, or typed once by the person.

        Raises
        ------
        ConfigError : no name is known.
        """
        if not self.user.name:
            self.desk.gradebooks.signed = self.text("by") or self.desk.gradebooks.signed
        if not self.signature:
            raise ConfigError("enter your name first: every change by hand is signed")
        return self.signature

    def require_place(self) -> None:
        """Refuse the request if its folder was moved or deleted, or its disk is not connected.

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
    def sees_check(self) -> bool:
        """Whether the room shows this person the check instead of the report."""
        return self.desk.visibility.sees_check(self.user, self.place)

    @property
    def job(self) -> Job | None:
        """The last job in the place that the URL names.

        The job's text is hidden if this person may not read it.
        """
        place = self.place
        if not isinstance(place, Path):
            return None
        return self.desk.visibility.show_job(self.desk.jobs.of(place), self.user, place)

    def do(self, task: str, **arguments: Any) -> Any:
        """Let a worker do a short task in the folder that the URL names; see `WorkerPool.do`."""
        return self.desk.workers.do(task, folder=str(self.folder()), **arguments)

    def start(self, task: str, *, title: str, **arguments: Any) -> None:
        """Start a long task in the folder that the URL names.

        Parameters
        ----------
        arguments : arguments of the task, apart from the folder.
        """
        folder = self.folder()
        self.desk.jobs.start(task, title=title, place=folder, folder=str(folder), **arguments)

    def stop(self, folder: Path) -> None:
        """Stop the job in a folder; what is already done stays."""
        if job := self.desk.jobs.of(folder):
            job.stop.set()

    @property
    def here(self) -> str:
        """The URL of the room: the first two parts of the request's URL."""
        return "/".join(self.request.url.path.split("/")[:3]).rstrip("/") + "/"

    def _room(self, place: str = "") -> tuple[str, str]:
        """Return the key for messages: the person, and the room's URL followed by `place`."""
        return self.user.name, self.here + place

    @property
    def sent(self) -> FormData | QueryParams:
        """The form of a POST, or the query of the URL."""
        return self.form if self.request.method == "POST" else self.request.query_params

    def text(self, name: str) -> str:
        """Return a field of the form or query as text; "" if it is missing."""
        value = self.sent.get(name)
        return value.replace("\r\n", "\n").strip() if isinstance(value, str) else ""

    def query(self, name: str) -> str:
        """Return a value from the URL's query, even if a form was sent; "" if it is missing."""
        return self.request.query_params.get(name, "")

    def page(self, template: str, *, status: int = 200, **context: Any) -> Response:
        """Return a page made from a template, with the state of its folder's job.

        An answer to htmx leaves out the parts that the browser has; see `parts`.
        """
        folder = self.place if isinstance(self.place, Path) else None
        everywhere = {
            "user": self.user,
            "path": self.request.url.path,
            "here": self.here,
            "rooms": list_links(self.user, self.request.url.path, self.desk.gradebooks),
            "version": __version__,
            "folder": folder if self.user.sees_places else folder and Path(folder.name),
            "job": self.job,
            "signature": self.signature,
            # Reading the messages removes them, so that they are shown only once.
            "messages": lambda place="": self.desk.messages.pop(self._room(place), []),
        }
        text = _environment().get_template(f"{template}.html.j2").render(everywhere | context)
        text = leave_out_parts(text, self.request.headers.get("x-parts", ""))
        if prefix := self.request.scope.get("prefix"):
            text = _ADDRESS.sub(lambda found: f'{found[1]}="{escape(prefix)}/', text)
        return HTMLResponse(text, status_code=status)

    def go(self, to: str) -> Response:
        """Return an answer that makes htmx open another page.

        The address gets the prefix here, because no proxy adds it to this header.
        """
        return Response(headers={"HX-Redirect": self.request.scope.get("prefix", "") + to})

    def back(self, to: str, *messages: str | Message, place: str = "") -> Response:
        """Return to a page that shows messages once, at the top or in the part named `place`."""
        if messages:
            lines = [Message(one) if isinstance(one, str) else one for one in messages]
            self.desk.messages.setdefault(self._room(place), []).extend(lines)
        return RedirectResponse(to, status_code=303)


# Addresses in pages of the desk. Text that others wrote cannot match, because its quotation marks
# are escaped.
_ADDRESS = re.compile(
    r'\b(href|src|action|formaction|hx-get|hx-post|data-events|data-page)="/(?!/)'
)

# A parameter, as `symbol_text` writes it.
_INDEX = re.compile(r"(?<!\w)([KTωζ])_(\w+)")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES / "desk"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "called": name_place,
        "breakable": breakable,
        "points": points_text,
        "lowered": lower_indices,
    }
    # This random number in the addresses of style sheets and scripts keeps browsers from using old
    # copies.
    environment.globals["fresh"] = secrets.token_hex(4)
    return environment


def lower_indices(text: str) -> Markup:
    """Return a text as HTML in which the indices of parameters are lowered, as in ω_n."""
    return Markup(_INDEX.sub(r"\1<sub>\2</sub>", str(escape(text))))


def prepare_pages() -> None:
    """Compile all templates now, so that the first page opens faster."""
    for name in _environment().list_templates(extensions=["j2"]):
        _environment().get_template(name)


def plain_error(ask: PageRequest, text: str, *, status: int) -> Response:
    """Return a page with an error message."""
    shown = ask.user.name_places(text)
    return ask.page("wrong", status=status, title="That did not work", text=shown)
