"""The preview page: the points of a graded class under a rubric that is not saved yet."""

import re
from typing import Any

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.instructor.rubric_draft import read_draft
from pipeline.desk.instructor.rubric_editor import read_rubric_path, show_editor
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_drawing
from pipeline.desk.users import Place, name_place
from pipeline.grading.words import points_text
from pipeline.report.figures.grading import two_distributions_figure
from pipeline.report.figures.style import drawing
from pipeline.report.figures.svg import plain_svg, to_svg
from pipeline.report.render.html import render_drawing

_BARS = re.compile(r"[0-9]{1,5}(\.[0-9]{1,5}){1,49}")  # the bars in an address: "0.2.5.1"
_ROWS = 30  # rows shown at once; the other rows are folded


def preview(ask: PageRequest) -> Response:
    """Show the points of a class under the typed rubric; nothing is saved."""
    path, typed, seen = read_rubric_path(ask), read_draft(ask.form), ask.text("seen")
    if typed.rubric is None:
        return show_editor(ask, path, typed, version=seen, status=422)
    number, place = _find_class(ask)
    found = ask.desk.workers.do("preview_rubric", folder=str(place), text=typed.text)
    teams = _named(ask, place, found["teams"])
    changed = [team for team in teams if team["criteria"] or team["gain"] or team["late"]]
    had, has = ([team[key] for team in teams] for key in ("before", "after"))
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
        first=changed[:_ROWS],
        rest=changed[_ROWS:],
        changed=len(changed),
        means=[points_text(sum(one) / len(one)) for one in (had, has) if one],
        drawn="&".join(
            f"{key}={'.'.join(map(str, found[f'bars_{key}']))}" for key in ("before", "after")
        ),
        points=points_text,
        criteria={c.id: c.title or c.id for c in typed.rubric.criteria},
        is_of=found["assignment"] == path.stem,
    )


def draw_preview(ask: PageRequest) -> Response:
    """Draw two distributions, whose bars are in the URL."""
    before, after = (_read_bars(ask.query(key)) for key in ("before", "after"))
    if len(before) != len(after):
        raise HTTPException(404, "there is no such drawing")
    with drawing():
        figure = two_distributions_figure(before, after)
        alt = "Histograms of the points, before and after."
        return show_drawing(
            render_drawing(plain_svg(to_svg(figure, name="distributions", alt=alt)))
        )


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


def _named(ask: PageRequest, place: Place, teams: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the changes with the names that the class shows, the largest change first."""
    names = ask.desk.gradebooks.of(place).names
    shown = [
        team
        | {
            "name": team["submission"] if names is None else names[team["submission"]],
            "gain": round(team["after"] - team["before"], 6),
            "late": team["late_before"] != team["late_after"],
        }
        for team in teams
    ]
    return sorted(shown, key=lambda team: (-abs(team["gain"]), team["name"]))
