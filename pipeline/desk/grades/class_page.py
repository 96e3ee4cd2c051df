"""The page of a class: its teams, recent changes, drawings, and the actions on all teams."""

import zipfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.gradebooks import ClassView
from pipeline.desk.grades.grading_form import GradingForm, fill_form, grade_again, show_unfinished
from pipeline.desk.grades.review_order import Filter
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import scratch_folder, show_drawing, show_own_page
from pipeline.desk.users import name_place
from pipeline.errors import ConfigError
from pipeline.grading.grade import CODES
from pipeline.grading.gradebook.decisions import read_wishes
from pipeline.grading.gradebook.events import TOTAL
from pipeline.grading.gradebook.history import to_the_second
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.class_page import class_page, not_final
from pipeline.grading.publish.export import export, export_feedback
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.outputs import repeated_authors_of
from pipeline.grading.publish.pseudonyms import STRANGER
from pipeline.grading.publish.view import view
from pipeline.grading.similarity.class_questions import find_distant, recomputed_numbers
from pipeline.grading.similarity.shared_flag import find_clusters, renamed
from pipeline.grading.words import WORDS, points_text, signed_points
from pipeline.output import zip_bytes
from pipeline.report.figures.grading import distribution_figure
from pipeline.report.figures.style import drawing, to_svg
from pipeline.report.html import render_drawing
from pipeline.words.numbers import count
from pipeline.words.text import capital

_ROWS = 50  # rows of one page
_MOST_SETS = 20
_MOST_NEWS = 8


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
    titles = {id_: capital(title) for id_, title in shown.rubric.titles.items()}
    unseen = Filter(seen="no").chosen(shown)
    return ask.page(
        "grades",
        status=422 if form else 200,
        title=shown.rubric.title or name_place(ask.place_or_404()),
        teams=chosen[_ROWS * (page - 1) : _ROWS * page],
        found=len(chosen),
        total=len(shown.teams),
        held=sum(bool(team.hold) for team in shown.teams.values()),
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
        held_criteria=ask.gradebook.held_criteria,
        platforms=PLATFORMS.values(),
    )


def show_clean(ask: PageRequest) -> Response:
    """Show the list of teams that can be accepted together: no flag, and not yet reviewed."""
    shown = ask.class_view
    return ask.page(
        "clean",
        title="Teams without a flag",
        teams=[one for one in Filter(seen="no").chosen(shown) if not one.grade.in_doubt],
        titles={id_: capital(title) for id_, title in shown.rubric.titles.items()},
    )


def count_flags(shown: ClassView) -> list[dict[str, Any]]:
    """Return the flags of a class with the number of their teams, the most common first."""
    found = Counter(code for team in shown.teams.values() for code in team.grade.codes)
    common = sorted(found, key=lambda code: (-found[code], CODES.index(code)))
    titles = {code: capital(WORDS.text(f"title_{code}")) for code in common}
    return [{"key": code, "title": titles[code], "many": found[code]} for code in common]


def count_lost(shown: ClassView, titles: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the criteria in which points were lost, those with most teams first."""
    lost = sorted(((key, len(names)) for key, names in shown.lost.items()), key=lambda one: -one[1])
    return [{"key": key, "title": titles[key], "many": many} for key, many in lost if many]


def show_news(ask: PageRequest) -> Response:
    """Show which points were changed since a page was loaded; empty if none were."""
    shown = ask.class_view
    since, latest = (_read_number(ask, name) for name in ("since", "told"))
    answer = ask.page("news", title="", news=list_news(ask, shown, since=since))
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
        titles = shown.rubric.titles
        for submission, override in ask.gradebook.changes_since(since):
            name = of_name.get(submission, STRANGER)
            points = "as graded" if override.points is None else points_text(override.points)
            points = "a comment" if override.what == "comment" else points
            what = titles.get(override.criterion, override.criterion)
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
            held=[name for name, team in shown.teams.items() if team.hold],
        )

    return show_own_page(ask.desk.gradebooks.drawn(ask.place_or_404(), "class", draw))


def show_feedback(ask: PageRequest) -> Response:
    """Show the feedback that a team reads, in its current state."""
    team = ask.class_view.team(ask.request.path_params["name"])
    team = team.without(ask.gradebook.held_criteria)
    figures, name = ask.gradebook.figures(team), team.grade.submission
    return show_own_page(feedback_page(view(team, "staff"), figures=figures, name=name))


# --------------------------------------------------------------------- actions


def take_table(ask: PageRequest) -> Response:
    """Change points from an uploaded table, either all of them or none."""
    shown = ask.class_view
    by = ask.sign()
    with scratch_folder() as scratch:
        table = _store_upload(ask, "table", scratch / "the table")
        if table is None:
            raise ConfigError("choose a file first")
        wishes = read_wishes(table)
    teams = {name: team.submission for name, team in shown.teams.items()}
    meant = []
    for wish in wishes:
        if wish.submission not in teams:
            raise ConfigError(f"line {wish.line}: no submission of this class has this name")
        meant.append(replace(wish, submission=teams[wish.submission]))
    done = ask.gradebook.change_all(meant, by=by)
    message = f"{count(done.teams, 'change')} imported"
    if unchanged := len(meant) - done.teams:
        message += f"; {count(unchanged, 'row')} changed nothing"
    return ask.back(ask.here, f"{message}.")


def accept(ask: PageRequest) -> Response:
    """Mark the ticked teams as reviewed; a team that changed since it was listed is not."""
    shown, by = ask.class_view, ask.sign()
    ticked = [str(name) for name in ask.form.getlist("team")]
    if not ticked or any(name not in shown.teams for name in ticked):
        raise ConfigError("tick at least one team of the class")
    seen = {shown.teams[name].submission: ask.text(f"seen.{name}") for name in ticked}
    done = ask.gradebook.accept_all(seen, by=by)
    message = f"{count(done.teams, 'team')} accepted."
    if done.kept:
        message += f" {count(len(done.kept), 'team')} changed meanwhile: look again."
    return ask.back(ask.here, message)


def release(ask: PageRequest) -> Response:
    """Let students with accounts read their feedback, or hide it again."""
    if not may_release(ask):
        raise HTTPException(
            403, "only the instructor decides when students can read their feedback"
        )
    released = ask.text("do") == "release"
    held = ask.gradebook.release(released, by=ask.sign())
    message = "The grades are published." if released else "The grades are no longer published."
    if held:
        message += f" {count(len(held), 'team')} with shared recordings held back: review them."
    return ask.back(f"{ask.here}#work", message)


def hold_criterion(ask: PageRequest) -> Response:
    """Hold a criterion back for the whole class, or no longer."""
    criterion, held = ask.text("criterion"), ask.text("do") == "hold"
    if not held and not may_release(ask):
        raise HTTPException(403, "only the instructor decides when students can read a criterion")
    ask.gradebook.hold_criterion(criterion, held, why=ask.text("why"), by=ask.sign())
    title = capital(ask.class_view.rubric.titles[criterion])
    return ask.back(f"{ask.here}#work", f"{title}: {'' if held else 'no longer '}held back.")


def export_class(ask: PageRequest) -> Response:
    """Return grades or feedback for a learning platform: one file, or a zip with remarks.

    A zip of feedback files can be uploaded with its remarks: a platform ignores a file whose name
    belongs to no student.
    """
    platform = PLATFORMS.get(ask.text("lms"))
    if platform is None:
        raise HTTPException(400, "there is no such platform")
    what = "feedback" if ask.text("what") == "feedback" else "grades"
    with scratch_folder() as scratch:
        roster = _store_upload(ask, "roster", scratch / "roster.csv")
        out = scratch / "export"
        book, title = ask.gradebook, ask.text("title") or None
        if what == "feedback":
            done = export_feedback(book, platform, out, roster=roster)
        else:
            done = export(book, platform, out, title=title, roster=roster)
        if len(done.files) == 1 and not done.remarks:
            (file,) = done.files
            kind = "text/csv" if file.suffix == ".csv" else "application/zip"
            return _download(file.read_bytes(), file.name, kind=kind)
        if what == "feedback":
            with zipfile.ZipFile(done.files[0]) as packed:
                files = {name: packed.read(name) for name in packed.namelist()}
        else:
            files = {file.relative_to(out).as_posix(): file.read_bytes() for file in done.files}
        if done.remarks:  # remarks may name students, so they go into the zip, not on a page
            told = "".join(f"{remark.text}\n" for remark in done.remarks)
            files["remarks.txt"] = told.encode()
    name = f"{what}-{platform.name}.zip"
    return _download(zip_bytes(files.items()), name, kind="application/zip")


def grade(ask: PageRequest) -> Response:
    """Grade the class again, or for the first time if an earlier attempt did not end."""
    if ask.gradebook.is_graded:
        anonymous, refuse = ask.class_view.rubric.anonymous, partial(show, ask)
        return grade_again(ask, is_first=False, anonymous=anonymous, refuse=refuse)
    anonymous, refuse = bool(ask.text("anonymous")), partial(show_unfinished, ask)
    return grade_again(ask, is_first=True, anonymous=anonymous, refuse=refuse)


def _store_upload(ask: PageRequest, name: str, path: Path) -> Path | None:
    """Write an uploaded file to a path; return None if nothing was uploaded."""
    sent = ask.form.get(name)
    if not isinstance(sent, UploadFile) or not sent.filename:
        return None
    path.write_bytes(sent.file.read())  # the limit on requests keeps it small
    return path


def _download(content: bytes, name: str, *, kind: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)
