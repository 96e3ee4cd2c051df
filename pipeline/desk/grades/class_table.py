"""The page of a class: the table of teams, recent changes, and drawings."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.responses import Response

from pipeline.desk.gradebooks import ClassView
from pipeline.desk.grades.grading_form import GradingForm, fill_form, show_unfinished
from pipeline.desk.grades.review_order import Filter
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_drawing, show_own_page
from pipeline.desk.users import name_place
from pipeline.grading.grade import CODES
from pipeline.grading.gradebook.events import TOTAL
from pipeline.grading.gradebook.history import to_the_second
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.class_page import class_page, not_final
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.outputs import repeated_authors_of
from pipeline.grading.publish.pseudonyms import STRANGER
from pipeline.grading.publish.view import view
from pipeline.grading.similarity.class_questions import find_distant, recomputed_numbers
from pipeline.grading.similarity.shared_flag import find_clusters, renamed
from pipeline.grading.words import WORDS, points_text, signed_points
from pipeline.report.figures.grading import distribution_figure
from pipeline.report.figures.style import drawing, to_svg
from pipeline.report.html import render_drawing
from pipeline.words.text import capital

_ROWS = 50  # rows of one page
_MOST_SETS = 20
_MOST_NEWS = 8


@dataclass(frozen=True, kw_only=True)
class Counted:
    """A flag or criterion, and the number of teams that have the flag or lost points for it."""

    key: str
    title: str
    many: int


def may_release(ask: PageRequest) -> bool:
    """Return whether the person may decide when students read their feedback."""
    return ask.user.role in ("instructor", "owner")


def show(ask: PageRequest, form: GradingForm | None = None) -> Response:
    """Show one page of the table of teams; or the first grading of the class, while it runs.

    Parameters
    ----------
    form : the refused form to grade the class again.
    """
    if isinstance(ask.place_or_404(), Path) and not ask.gradebook.is_graded:
        return show_unfinished(ask)
    shown, wanted = ask.class_view, Filter.read(ask.request.query_params)
    chosen = wanted.chosen(shown)
    pages = max(1, -(-len(chosen) // _ROWS))
    page = min(max(_read_number(ask, "page"), 1), pages)
    graded = sorted(t.grade.points for t in shown.teams.values() if t.grade.status == "graded")
    titles = {asked.id: capital(asked.title or asked.id) for asked in shown.rubric.criteria}
    unseen = Filter(seen="no").chosen(shown)
    return ask.page(
        "grades",
        status=422 if form else 200,
        title=shown.rubric.title or name_place(ask.place_or_404()),
        teams=chosen[_ROWS * (page - 1) : _ROWS * page],
        points=points_text,
        found=len(chosen),
        total=len(shown.teams),
        failed=sum(team.grade.status == "failed" for team in shown.teams.values()),
        not_final=not_final([team.grade for team in shown.teams.values()]),
        words=WORDS,
        titles=titles,
        next=unseen[0].grade.submission if unseen else "",
        clean=sum(not team.grade.in_doubt for team in unseen),
        flags=count_flags(shown),
        lost=count_lost(shown, titles),
        sets=ask.gradebook.changed_together()[:_MOST_SETS],
        seen=sum(bool(team.reviewed_by) for team in shown.teams.values()),
        median=points_text(graded[len(graded) // 2]) if graded else "",
        out_of=points_text(shown.rubric.out_of),
        named=shown.names is None,
        fields=wanted.fields(shown),
        wanted=wanted,
        page=page,
        pages=pages,
        to_page=lambda number: f"?{urlencode({'page': number})}&{wanted.query}",
        drawn="-".join(map(str, shown.state)),
        news=list_news(ask, shown, since=shown.state[1]),
        form=form or fill_form(ask, named=shown.names is None),
        n_requests=ask.gradebook.n_waiting(),
        released=ask.gradebook.released,
        may_release=may_release(ask),
        platforms=PLATFORMS.values(),
    )


def show_clean(ask: PageRequest) -> Response:
    """Show the list of teams that can be accepted together: no remark, and not yet reviewed."""
    shown = ask.class_view
    return ask.page(
        "clean",
        title="Teams without a remark",
        teams=[one for one in Filter(seen="no").chosen(shown) if not one.grade.in_doubt],
        points=points_text,
        titles={asked.id: capital(asked.title or asked.id) for asked in shown.rubric.criteria},
        signature=ask.signature,
    )


def count_flags(shown: ClassView) -> list[Counted]:
    """Return the flags of a class, the most common first."""
    found = Counter(code for team in shown.teams.values() for code in team.grade.codes)
    common = sorted(found, key=lambda code: (-found[code], CODES.index(code)))
    titles = {code: capital(WORDS.text(f"title_{code}")) for code in common}
    return [Counted(key=code, title=titles[code], many=found[code]) for code in common]


def count_lost(shown: ClassView, titles: Mapping[str, str]) -> list[Counted]:
    """Return the criteria in which points were lost, those with most teams first."""
    found = [Counted(key=k, title=titles[k], many=len(v)) for k, v in shown.lost.items() if v]
    return sorted(found, key=lambda one: -one.many)


def show_news(ask: PageRequest) -> Response:
    """Show which points were changed since a page was loaded; empty if none were."""
    shown = ask.class_view
    since, latest = (_read_number(ask, name) for name in ("since", "told"))
    answer = ask.page(
        "news",
        title="",
        news=list_news(ask, shown, since=since),
    )
    if shown.state[1] == latest:
        answer.headers["HX-Reswap"] = "none"
    return answer


def list_news(ask: PageRequest, shown: ClassView, *, since: int) -> dict[str, Any]:
    """Return the changes after a given one, as a page shows them.

    Parameters
    ----------
    since : number of the last change that the page knows.
    """
    changes, latest = [], shown.state[1]
    about = ask.query("of")
    if latest != since:
        of_name = {team.submission: name for name, team in shown.teams.items()}
        titles = {asked.id: asked.title for asked in shown.rubric.criteria}
        for submission, override in ask.gradebook.changes_since(since):
            name = of_name.get(submission, STRANGER)
            points = "as graded" if override.points is None else points_text(override.points)
            points = "a comment" if override.what == "comment" else points
            what = titles.get(override.criterion) or override.criterion
            if override.criterion == TOTAL:
                what, points = "total", signed_points(override.points or 0.0)
            at = to_the_second(override.at)
            text = f"{what}: {points}, by {override.by}: {override.text} ({at})"
            changes.append({"name": name, "text": text, "mine": name == about})
    more = len(changes) - _MOST_NEWS
    return {"since": since, "told": latest, "changes": changes[::-1][:_MOST_NEWS],
            "more": max(more, 0), "of": about}  # fmt: skip


def _read_number(ask: PageRequest, name: str) -> int:
    text = ask.query(name)
    return int(text) if text.isdecimal() and len(text) < 16 else 0


# --------------------------------------------------------------------- what is drawn


def draw_distribution(ask: PageRequest) -> Response:
    """Draw the distribution of points."""
    return show_drawing(
        ask.desk.gradebooks.drawn(ask.place_or_404(), "distribution", _distribution)
    )


def _distribution(shown: ClassView) -> str:
    points = [t.grade.points for t in shown.teams.values() if t.grade.status == "graded"]
    with drawing():
        figure = distribution_figure(points, out_of=shown.rubric.out_of)
        alt = "Histogram of the points."
        return render_drawing(to_svg(figure, name="distribution", alt=alt))


def show_class_page(ask: PageRequest) -> Response:
    """Show the class page of `cartlab grade`, made from the current gradebook."""
    book = ask.gradebook

    def draw(shown: ClassView) -> str:
        own = {entry.submission: entry for entry in shown.now.entries}
        flags = {
            name: flag
            for name in sorted(own)
            for flag in own[name].graded.flags
            if flag.code == "shared_data"
        }
        clusters = find_clusters(flags)
        if shown.names is not None:
            clusters = renamed(clusters, shown.names, other=STRANGER)
        doubles = repeated_authors_of(
            book,
            {team.submission: team.grade.authors for team in shown.teams.values()},
            gradings={name: one.grading for name, one in own.items()},
            names=shown.names,
        )
        grades = [team.grade for team in shown.teams.values()]
        numbers = {g.submission: recomputed_numbers(g, rubric=shown.rubric) for g in grades}
        return class_page(
            grades,
            rubric=shown.rubric,
            repeated_authors=doubles,
            clusters=clusters,
            distant=find_distant(numbers),
        )

    return show_own_page(ask.desk.gradebooks.drawn(ask.place_or_404(), "class", draw))


def show_feedback(ask: PageRequest) -> Response:
    """Show the feedback that a team reads, in its current state."""
    shown = ask.class_view
    team = shown.team(ask.request.path_params["name"])
    book = ask.gradebook
    entry = book.entry(team.submission)
    seen = view(entry, "staff", names=shown.names)
    page = feedback_page(seen, figures=book.figures(entry), name=seen.grade.submission)
    return show_own_page(page)
