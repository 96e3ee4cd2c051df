"""A class at the desk: the table, who changed what, what is drawn of it."""

from typing import Any
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.books import Class, Team
from pipeline.desk.grades.filters import Filter
from pipeline.desk.state import Ask
from pipeline.desk.users import place_name
from pipeline.grading.gradebook.history import to_the_second
from pipeline.grading.publish.anonymous import STRANGER, anonymise
from pipeline.grading.publish.class_page import class_page
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.outputs import doubles_of
from pipeline.grading.similarity.clusters import find_clusters, renamed
from pipeline.grading.words import WORDS, points_text
from pipeline.report.figures.grading import distribution_figure
from pipeline.report.figures.style import drawing
from pipeline.report.figures.svg import plain_svg, to_svg
from pipeline.report.render.html import every_hash, render_drawing

_ROWS = 50  # of a page
_MOST_NEWS = 8
# Pages of our own making, whole: their one script is known by its hash.
_OWN = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:; "
    "font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_DRAWING = "sandbox; default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"


def a_class(ask: Ask) -> Class:
    """Return the class that the address is about."""
    place = ask.grades()
    return ask.desk.books.of(place)


def a_team(ask: Ask, shown: Class) -> Team:
    """Return the team that the address is about, by the name that is shown."""
    team = shown.teams.get(ask.request.query_params.get("of", ""))
    if team is None:
        raise HTTPException(404, "no submission of this class is called so")
    return team


def signature(ask: Ask) -> str:
    """Return the name under which somebody changes points, "" where it is not known yet."""
    return ask.user.name or ask.desk.books.signed


def show(ask: Ask) -> Response:
    """Show the class, a page of it."""
    shown, wanted = a_class(ask), Filter.read(ask.request.query_params)
    chosen = wanted.chosen(shown)
    pages = max(1, -(-len(chosen) // _ROWS))
    asked = ask.request.query_params.get("page", "1")
    page = min(max(int(asked) if asked.isdecimal() and len(asked) < 9 else 1, 1), pages)
    graded = sorted(t.line.points for t in shown.teams.values() if t.line.status == "graded")
    return ask.page(
        "grades",
        title=shown.rubric.title or place_name(ask.grades()),
        teams=chosen[_ROWS * (page - 1) : _ROWS * page],
        points=points_text,
        found=len(chosen),
        total=len(shown.teams),
        failed=sum(team.line.status == "failed" for team in shown.teams.values()),
        sharing=sum("shared_data" in team.line.codes for team in shown.teams.values()),
        words=WORDS,
        seen=sum(bool(team.seen) for team in shown.teams.values()),
        median=points_text(graded[len(graded) // 2]) if graded else "",
        out_of=points_text(shown.rubric.out_of),
        named=shown.names is None,
        fields=wanted.fields(shown),
        wanted=wanted,
        page=page,
        pages=pages,
        to_page=lambda number: f"?{urlencode({'page': number})}&{wanted.query}",
        drawn="-".join(map(str, shown.state)),
        news=news_of(ask, shown, since=shown.state[1]),
        signature=signature(ask),
        folder=ask.grades() if not isinstance(ask.grades(), str) else None,
        job=ask.desk.jobs.of(ask.grades()),  # type: ignore[arg-type]
        asked=ask.desk.books.asked.get(ask.grades(), {}),
        said=ask.told(),
    )


def news(ask: Ask) -> Response:
    """Tell which points were changed since a page was shown; nothing where nothing is new."""
    shown = a_class(ask)
    since, told = (_number(ask, name) for name in ("since", "told"))
    answer = ask.page("news", title="", news=news_of(ask, shown, since=since))
    if shown.state[1] == told:
        answer.headers["HX-Reswap"] = "none"
    return answer


def news_of(ask: Ask, shown: Class, *, since: int) -> dict[str, Any]:
    """Return what a page tells of changes after one of a number."""
    changes, told = [], shown.state[1]
    about = ask.request.query_params.get("of", "")
    if told != since:
        of_name = {team.submission: name for name, team in shown.teams.items()}
        for submission, override in ask.desk.books.book(ask.grades()).changes_since(since):
            name = of_name.get(submission, STRANGER)
            given = "as graded" if override.points is None else points_text(override.points)
            text = (
                f"{override.criterion}: {given}, by {override.by}: {override.why} "
                f"({to_the_second(override.at)})"
            )
            changes.append({"name": name, "text": text, "mine": name == about})
    more = len(changes) - _MOST_NEWS
    return {"since": since, "told": told, "changes": changes[::-1][:_MOST_NEWS],
            "more": max(more, 0), "of": about}  # fmt: skip


def _number(ask: Ask, name: str) -> int:
    text = ask.request.query_params.get(name, "")
    return int(text) if text.isdecimal() and len(text) < 16 else 0


# --------------------------------------------------------------------- what is drawn


def distribution(ask: Ask) -> Response:
    """Draw how many submissions have how many points."""
    a_class(ask)
    return drawing_response(ask.desk.books.drawn(ask.grades(), "distribution", _distribution))


def _distribution(shown: Class) -> str:
    points = [t.line.points for t in shown.teams.values() if t.line.status == "graded"]
    with drawing():
        figure = distribution_figure(points, out_of=shown.rubric.out_of)
        alt = "Histogram of the points."
        return render_drawing(plain_svg(to_svg(figure, name="distribution", alt=alt)))


def at_a_glance(ask: Ask) -> Response:
    """Show the class page as `cartlab grade` writes it, of the gradebook as it is now."""
    a_class(ask)
    book = ask.desk.books.book(ask.grades())

    def draw(shown: Class) -> str:
        teams = shown.teams.values()
        own = {t.submission: t.listing for t in teams}
        flags = {name: one.shared for name, one in sorted(own.items()) if one.shared}
        clusters = find_clusters(flags)
        if shown.names is not None:
            clusters = renamed(clusters, shown.names, other=STRANGER)
        doubles = doubles_of(
            book,
            {name: one.line.authors for name, one in own.items()},
            gradings={name: one.grading for name, one in own.items()},
            names=shown.names,
        )
        lines = [team.line for team in teams]
        return class_page(lines, rubric=shown.rubric, doubles=doubles, clusters=clusters)

    return _own_page(ask.desk.books.drawn(ask.grades(), "class", draw))


def feedback(ask: Ask) -> Response:
    """Show what a team reads, as it is now."""
    shown = a_class(ask)
    team = shown.teams.get(ask.request.path_params["name"])
    if team is None:
        raise HTTPException(404, "no submission of this class is called so")
    book = ask.desk.books.book(ask.grades())
    entry = book.entry(team.submission)
    grade = entry.grade if shown.names is None else anonymise(entry.grade, shown.names)
    figures = book.figures(entry)
    page = feedback_page(grade, rubric=shown.rubric, figures=figures, name=grade.submission)
    return _own_page(page)


def drawing_response(svg: str) -> Response:
    """Return a drawing, which runs nothing wherever it is opened."""
    return Response(svg, media_type="image/svg+xml", headers={"Content-Security-Policy": _DRAWING})


def _own_page(text: str) -> Response:
    hashes = " ".join(f"'{one}'" for one in every_hash())
    headers = {"Content-Security-Policy": _OWN.format(hashes=hashes)}
    return Response(text, media_type="text/html", headers=headers)
