"""The rubric editor: a form for the numbers next to the text; an invalid rubric is not saved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlencode

from starlette.responses import RedirectResponse, Response

from pipeline.desk.form_input import read_path
from pipeline.desk.grades.grading_form import last_run
from pipeline.desk.instructor.rubric_draft import RubricDraft, make_draft, read_draft
from pipeline.desk.instructor.rubric_list import (
    free_name,
    own_rubrics,
    shipped_names,
    shipped_rubrics,
    work_folder,
)
from pipeline.desk.page_request import PageRequest
from pipeline.desk.users import name_place
from pipeline.errors import ConfigError
from pipeline.grading.intake.repairs import Run
from pipeline.grading.rubric_file import rubric_source
from pipeline.grading.rubric_text import rubric_text
from pipeline.grading.words import WORDS, points_text
from pipeline.output import write_file
from pipeline.resources import RUBRICS
from pipeline.submission.edit import Stale, require_version, text_digest

_NEW = "new"  # version in a form whose file does not exist yet


@dataclass(frozen=True, kw_only=True)
class RubricPage:
    """What the editor of a rubric shows.

    Attributes
    ----------
    seen : version of the file on which the typed text is based.
    now : current text of the file, if somebody has changed it since.
    classes : number and name of each open class.
    graded : after saving: number and name of each class that the rubric graded, and what was
        graded last in it.
    """

    file: Path
    typed: RubricDraft
    seen: str
    now: str | None
    saved: bool
    classes: Sequence[tuple[int, str]]
    graded: Sequence[tuple[int, str, Run | None]]

    @property
    def is_new(self) -> bool:
        """Whether the file does not exist yet."""
        return self.seen == _NEW

    @property
    def in_words(self) -> str:
        """The rubric in words; "" while it is not valid."""
        return rubric_text(self.typed.rubric) if self.typed.rubric else ""


def show(ask: PageRequest) -> Response:
    """Show a rubric in the editor, or the list of rubrics if the request names no rubric.

    A new file starts as a copy of a shipped rubric, or empty.
    """
    start = ask.text("start")
    if not start and not ask.text("file"):
        return ask.page(
            "rubrics",
            title="Rubrics",
            shipped=shipped_rubrics(),
            own=own_rubrics(ask.user),
            points=points_text,
        )
    path = read_rubric_path(ask)
    if path.exists():
        text = rubric_source(path)
        return show_editor(ask, path, make_draft(text, {}), version=text_digest(text))
    text = rubric_source(RUBRICS / f"{start}.toml") if start in shipped_names() else ""
    return show_editor(ask, path, make_draft(text, {}), version=_NEW)


def check(ask: PageRequest) -> Response:
    """Show what is wrong with the typed rubric; nothing is saved."""
    return show_editor(ask, read_rubric_path(ask), read_draft(ask.form), version=ask.text("seen"))


def save(ask: PageRequest) -> Response:
    """Save a valid rubric, unless the file has changed since it was shown."""
    path, typed, seen = read_rubric_path(ask), read_draft(ask.form), ask.text("seen")
    try:
        if path.exists():
            require_version(rubric_source(path), seen, name=path.name)
        elif seen != _NEW:
            raise Stale(path.name, "")
    except Stale as error:
        return show_editor(ask, path, typed, version=seen, now=error.text, status=409)
    if typed.rubric is None:
        return show_editor(ask, path, typed, version=seen, status=422)
    write_file(path, typed.text)
    query = urlencode({"file": path, "saved": 1})
    return RedirectResponse(f"/rubric/?{query}", status_code=303)


def show_editor(
    ask: PageRequest,
    path: Path,
    typed: RubricDraft,
    *,
    version: str,
    now: str | None = None,
    status: int = 200,
) -> Response:
    """Show the editor.

    Parameters
    ----------
    version : version of the file on which the typed text is based.
    now : current text of the file, if somebody has changed it since.
    """
    saved = "saved" in ask.request.query_params
    page = RubricPage(
        file=path,
        typed=typed,
        seen=version,
        now=now,
        saved=saved,
        classes=[(n, name_place(place)) for n, place in enumerate(ask.user.gradebooks)],
        graded=_classes_of(ask, path) if saved else [],
    )
    functions = {"points": points_text, "words": WORDS}
    return ask.page("rubric", status=status, title=path.name, page=page, **functions)


def _classes_of(ask: PageRequest, path: Path) -> list[tuple[int, str, Run | None]]:
    """Return the open classes graded by a rubric file, with what was graded last in each."""
    found = []
    for n, place in enumerate(ask.user.gradebooks):
        try:
            book = ask.desk.gradebooks.gradebook(place)
            assignment, anonymous = book.assignment, book.rubric.anonymous
        except ConfigError:  # nothing is graded there yet, or the gradebook is gone
            continue
        if assignment == path.stem and isinstance(place, Path):
            run = last_run(ask.user, place)
            if run and anonymous:  # the paths may contain names
                run = replace(run, paths=())
            found.append((n, name_place(place), run))
    return found


def read_rubric_path(ask: PageRequest) -> Path:
    """Return the path of the rubric that the request names, or an unused one for a new rubric.

    Raises
    ------
    ConfigError : the path is not a TOML file in an existing folder that this person may use.
    """
    typed = ask.text("file")
    if not typed and ask.request.method == "GET":
        typed = free_name(work_folder(ask.user))
    wanted = "enter a file name for the rubric, such as rubric.toml"
    path = read_path(typed, wanted=wanted, inside=ask.user.workshop)
    if path.suffix != ".toml":
        raise ConfigError(f"{path}: a rubric is a .toml file")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: the folder {path.parent} does not exist")
    return path
