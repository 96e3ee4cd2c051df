"""The rubric's pages: the list to start from, the editor, and the preview of a graded class.

The editor has a form for the numbers next to the text. A rubric that is not valid is not saved.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

from pipeline.desk.browse import find_root, free_path
from pipeline.desk.form_input import keep_refusal, read_path
from pipeline.desk.grades.grading_form import last_run
from pipeline.desk.instructor.rubric_form import RubricDraft, make_draft, read_draft
from pipeline.desk.instructor.rubric_list import (
    own_rubrics,
    shipped_names,
    shipped_rubrics,
)
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_drawing
from pipeline.desk.users import Place, name_place
from pipeline.errors import ConfigError
from pipeline.grading.intake.repairs import Run
from pipeline.grading.rubric_file import rubric_source
from pipeline.grading.rubric_text import rubric_text
from pipeline.output import write_file
from pipeline.report.figures.grading import two_distributions_figure
from pipeline.report.figures.style import drawing, to_svg
from pipeline.report.html import render_drawing
from pipeline.resources import RUBRICS
from pipeline.submission.edit import Stale, require_version, text_digest
from pipeline.submission.load import NAME

_NEW = "new"  # version in a form whose file does not exist yet


# --------------------------------------------------------------------------- the editor


def show(ask: PageRequest) -> Response:
    """Show a rubric in the editor, or the list of rubrics if the request names no rubric.

    A new file starts as a copy of a shipped rubric, or empty.
    """
    start = ask.text("start")
    if not start and not ask.text("file"):
        own = own_rubrics(ask.user)
        return ask.page("rubrics", title="Rubrics", shipped=shipped_rubrics(), own=own)
    path = _read_rubric_path(ask)
    if path.exists():
        text = rubric_source(path)
        return _show_editor(ask, path, make_draft(text, {}), version=text_digest(text))
    text = rubric_source(RUBRICS / f"{start}.toml") if start in shipped_names() else ""
    return _show_editor(ask, path, make_draft(text, {}), version=_NEW)


def check(ask: PageRequest) -> Response:
    """Show what is wrong with the typed rubric; nothing is saved."""
    path = _read_typed_path(ask)
    if isinstance(path, Response):
        return path
    return _show_editor(ask, path, read_draft(ask.form), version=ask.text("seen"))


def save(ask: PageRequest) -> Response:
    """Save a valid rubric, unless the file has changed since it was shown."""
    path, typed, seen = _read_typed_path(ask), read_draft(ask.form), ask.text("seen")
    if isinstance(path, Response):
        return path
    try:
        if path.exists():
            require_version(rubric_source(path), seen, name=path.name)
        elif seen != _NEW:
            raise Stale(path.name, "")
    except Stale as error:
        return _show_editor(ask, path, typed, version=seen, now=error.text, status=409)
    if typed.rubric is None:
        return _show_editor(ask, path, typed, version=seen, status=422)
    write_file(path, typed.text)
    query = urlencode({"file": path, "saved": 1})
    return RedirectResponse(f"/rubric/?{query}", status_code=303)


def _show_editor(
    ask: PageRequest,
    path: Path | str,
    typed: RubricDraft,
    *,
    version: str,
    now: str | None = None,
    refused: str = "",
    no_students: str = "",
    status: int = 200,
) -> Response:
    """Show the editor.

    Parameters
    ----------
    version : version of the file on which the typed text is based.
    now : current text of the file, if somebody has changed it since.
    refused : why the path was refused, or "".
    no_students : why no students can be simulated, or "".
    """
    saved = "saved" in ask.request.query_params
    return ask.page(
        "rubric",
        status=status,
        title=Path(path).name or "A rubric",
        file=path,
        refused=ask.user.name_places(refused),
        no_students=ask.user.name_places(no_students),
        reference=ask.text("reference") or next(map(str, ask.user.folders), ""),
        typed=typed,
        in_words=rubric_text(typed.rubric) if typed.rubric else "",
        seen=version,
        is_new=version == _NEW,
        now=now,
        saved=saved,
        classes=[(n, name_place(place)) for n, place in enumerate(ask.user.gradebooks)],
        graded=_classes_of(ask, Path(path)) if saved else [],
    )


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


def _read_typed_path(ask: PageRequest) -> Path | Response:
    """Return the path in a sent form, or the editor with what was typed if it is refused."""
    seen = ask.text("seen")
    try:
        path = _read_rubric_path(ask)
        if seen != _NEW or not path.exists():
            return path
        refused, status = (
            f"{path.name}: exists already; choose another name, or open that rubric",
            409,
        )
    except ConfigError as error:
        refused, status = str(error), 422
    typed = read_draft(ask.form)
    return _show_editor(ask, ask.text("file"), typed, version=seen, refused=refused, status=status)


def _read_rubric_path(ask: PageRequest) -> Path:
    """Return the path of the rubric that the request names, or an unused one for a new rubric.

    Raises
    ------
    ConfigError : the path is not a TOML file in an existing folder that this person may use.
    """
    typed = ask.text("file")
    if not typed and ask.request.method == "GET":
        typed = free_path((ask.user.workshop or find_root()) / "rubric.toml").name
    wanted = "enter a file name for the rubric, such as rubric.toml"
    path = read_path(typed, wanted=wanted, inside=ask.user.workshop)
    if path.suffix != ".toml":
        raise ConfigError(f"{path}: a rubric is a .toml file")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: the folder {path.parent} does not exist")
    return path


# --------------------------------------------------------------------------- the preview

_BARS = re.compile(r"[0-9]{1,5}(\.[0-9]{1,5}){1,49}")  # the bars in an address: "0.2.5.1"
_ROWS = 30  # rows shown at once; the other rows are folded


def preview(ask: PageRequest) -> Response:
    """Show the points of a class under the typed rubric; nothing is saved."""
    path, typed, seen = _read_typed_path(ask), read_draft(ask.form), ask.text("seen")
    if isinstance(path, Response):
        return path
    if typed.rubric is None:
        return _show_editor(ask, path, typed, version=seen, status=422)
    number, place = _find_class(ask)
    found = ask.desk.workers.do("preview_rubric", folder=str(place), text=typed.text)
    teams = _name_teams(ask, place, found["teams"])
    points = {key: [team[key] for team in teams] for key in ("before", "after")}
    changed = [one for one in teams if one["criteria"] or one["gain"] or one["late"]]
    bars = {key: ".".join(map(str, found[f"bars_{key}"])) for key in points}
    return ask.page(
        "rubric_preview",
        title=f"{path.name}: preview",
        file=path,
        text=typed.text,
        seen=seen,
        number=number,
        called=name_place(place),
        found=found,
        teams=teams,
        changed=changed,
        first=changed[:_ROWS],
        rest=changed[_ROWS:],
        means=[sum(of) / len(of) for of in points.values()] if teams else [],
        drawn=urlencode(bars),
        is_of=found["assignment"] == path.stem,
        titles=typed.rubric.titles,
    )


# ----------------------------------------------------------------------- simulated students


def simulate(ask: PageRequest) -> Response:
    """Start the task that grades simulated students with the typed rubric; nothing is saved."""
    path, typed, seen = _read_typed_path(ask), read_draft(ask.form), ask.text("seen")
    if isinstance(path, Response):
        return path
    wrong: dict[str, str] = {}
    with keep_refusal("reference", wrong):
        folder = _read_reference(ask)
        if typed.rubric is not None:
            task = {"folder": str(folder), "text": typed.text}
            ask.desk.jobs.start("simulate_students", title="Simulated students", place=path, **task)
    if wrong or typed.rubric is None:
        refused = wrong.get("reference", "")
        return _show_editor(ask, path, typed, version=seen, no_students=refused, status=422)
    query = urlencode({"file": path, "seen": seen})
    return RedirectResponse(f"/rubric/simulated?{query}", status_code=303)


def _read_reference(ask: PageRequest) -> Path:
    wanted = "enter the folder of a submission whose recordings the students have"
    folder = read_path(ask.text("reference"), wanted=wanted, inside=ask.user.workshop)
    if not (folder / NAME).is_file():
        raise ConfigError(f"{folder}: has no {NAME}; {wanted}")
    return folder


def show_simulated(ask: PageRequest) -> Response:
    """Show the progress of grading simulated students, or their points."""
    path = _read_rubric_path(ask)
    job = ask.desk.jobs.of(path)
    if job is None or job.task[0] != "simulate_students":
        raise HTTPException(404, "no students were simulated for this rubric")
    text = job.task[1]["text"]
    title = f"{path.name}: simulated students"
    asked = {"file": path, "text": text, "seen": ask.text("seen"), "job": job}
    return ask.page("rubric_simulated", title=title, **asked)


def draw_preview(ask: PageRequest) -> Response:
    """Draw two distributions, whose bars are in the URL."""
    before, after = (_read_bars(ask.query(key)) for key in ("before", "after"))
    if len(before) != len(after):
        raise HTTPException(404, "there is no such drawing")
    with drawing():
        figure = two_distributions_figure(before, after)
        alt = "Histograms of the points, before and after."
        return show_drawing(render_drawing(to_svg(figure, name="distributions", alt=alt)))


def _read_bars(text: str) -> list[int]:
    if not _BARS.fullmatch(text):
        raise HTTPException(404, "there is no such drawing")
    return [int(part) for part in text.split(".")]


def _find_class(ask: PageRequest) -> tuple[int, Place]:
    typed = ask.text("class")
    books = ask.user.gradebooks
    if not typed.isascii() or not typed.isdecimal() or len(typed) > 6 or int(typed) >= len(books):
        raise HTTPException(404, "this class is not open at the desk")
    return int(typed), books[int(typed)]


def _name_teams(
    ask: PageRequest, place: Place, teams: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return the changes with the names that the class shows, the largest change first."""
    names = ask.desk.gradebooks.of(place).names
    shown = [
        {
            **team,
            "name": team["submission"] if names is None else names[team["submission"]],
            "gain": round(team["after"] - team["before"], 6),
            "late": team["late_before"] != team["late_after"],
        }
        for team in teams
    ]
    return sorted(shown, key=lambda team: (-abs(team["gain"]), team["name"]))
