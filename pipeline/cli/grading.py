"""Commands of a class: grade, override, history, export, survey, new-rubric, check-rubric."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.common import AsJson, app, ctrl_c_says, log_progress, progress_line, say
from pipeline.errors import ConfigError
from pipeline.grading.platforms import PLATFORMS

if TYPE_CHECKING:
    from rich.progress import Progress

    from pipeline.grading.batch.grade_class import Summary
    from pipeline.grading.gradebook.gradebook import Gradebook


@app.command()
def grade(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH…", help="Submission folders, trees of them, or zip files."),
    ],
    rubric: Annotated[Path, typer.Option(metavar="FILE", help="A rubric file or shipped name.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder with the gradebook.")],
    jobs: Annotated[int, typer.Option(min=1, help="Processes; default: one per core.")] = (
        os.cpu_count() or 1
    ),
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:PORT.")
    ] = None,
    time_limit: Annotated[
        float, typer.Option(min=1, help="Time limit for each submission, s.")
    ] = 120.0,
    memory_limit: Annotated[
        float, typer.Option(min=0.1, help="Memory limit for each submission, GB.")
    ] = 1.0,
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Draw the figures of the feedback.")
    ] = True,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Leave names out; anonymous-key.csv reveals them.")
    ] = False,
    gradebook: Annotated[
        str | None,
        typer.Option(metavar="URL", help="A database; default: gradebook.sqlite in --out."),
    ] = None,
    lateness: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Table of late submissions; see docs/batch.md."),
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The answer key of `simulate --vary`: true values."),
    ] = None,
) -> None:
    """Grade a class: gradebook, grades.csv, class page, feedback for each student."""
    from pipeline.grading.batch.grade_class import Options, grade_class

    options = Options(
        jobs=jobs,
        cluster=cluster,
        time_limit=time_limit,
        memory_limit=round(memory_limit * 1e9),
        figures=figures,
        anonymous=anonymous,
        gradebook=gradebook,
        lateness=lateness,
        key=str(key.resolve()) if key else "",
    )
    kept = f"stopped; finished grades are kept in {out}; repeat the command to continue"
    with ctrl_c_says(lambda: say(kept)) as check_stop, _batch_progress() as show:

        def progress(done: int, total: int, last: str) -> None:
            check_stop()
            show(done, total, last)

        def tell(text: str) -> None:
            check_stop()
            say(text)

        done = grade_class(
            paths, rubric_file=rubric, out=out, options=options, progress=progress, say=tell
        )
    _report_outcome(done, out=out, rubric=rubric)
    if done.failed:
        raise typer.Exit(1)


def _report_outcome(done: "Summary", *, out: Path, rubric: Path) -> None:
    for remark in done.remarks:
        say(remark)
    if done.changes:
        say("changes since the last class list:")
        for change in done.changes[:20]:
            say(f"  {change}")
        if (more := len(done.changes) - 20) > 0:
            say(f"  and {more} more; see cartlab history")
    for submission, reason in done.failed:
        say(f"{submission}: {reason}")
    if done.disk_full:
        say(
            f"the disk is full: {done.disk_full} of {done.total} submissions could not be "
            f"unpacked in {out}; free some space there and repeat the command"
        )
    if len(done.failed) == done.total > 1 and not done.unsettled:
        say(f"no submission could be graded: is {rubric} the rubric for these submissions?")
    say(f"{done.counted}; wrote {out}")


@contextmanager
def _batch_progress() -> Iterator[Callable[[int, int, str], None]]:
    """Show how many submissions are graded and, on a terminal, the remaining time."""
    if not sys.stderr.isatty():
        with log_progress() as show:
            yield lambda done, total, last: show(f"{done} of {total}: {last}".rstrip(": "))
        return
    from rich import progress
    from rich.console import Console

    # "3/40 ━━━ 0:00:06 so far, 0:01:05 to go, team-3"
    parts = (
        progress.MofNCompleteColumn(),
        progress.BarColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("so far,"),
        progress.TimeRemainingColumn(),
        progress.TextColumn("to go,"),
        progress.TextColumn("{task.description}", markup=False),  # a submission may be called "[b]"
    )
    with progress.Progress(*parts, console=Console(stderr=True), transient=True) as shown:
        yield counting(shown)


def counting(shown: "Progress") -> Callable[[int, int, str], None]:
    """Return a function that updates a progress bar.

    Submissions whose grades are already known do not count towards the speed.
    """
    task = shown.add_task("opening", total=None)

    def show(done: int, total: int, last: str) -> None:
        if shown.tasks[task].total is None:
            shown.reset(task, completed=done, total=total)
        shown.update(task, completed=done, total=total, description=last)

    return show


Grades = Annotated[
    str, typer.Argument(metavar="GRADES", help="The --out folder of `cartlab grade`, or a URL.")
]
Team = Annotated[
    str, typer.Argument(metavar="TEAM", help="A submission, one of its authors, or anon-….")
]
By = Annotated[str, typer.Option(metavar="NAME", help="Who decides.")]
Why = Annotated[str, typer.Option(help="The reason, which the student reads.")]
Lab = Annotated[
    str | None,
    typer.Option("--assignment", help="Name of the rubric, if the gradebook has several."),
]


@app.command(context_settings={"ignore_unknown_options": True})  # -1 is a number, not an option
def override(
    grades: Grades,
    by: By,
    team: Annotated[
        str, typer.Argument(metavar="[TEAM]", help="A submission, one of its authors, or anon-….")
    ] = "",
    criterion: Annotated[
        str, typer.Argument(metavar="[CRITERION]", help="Criterion id in the rubric.")
    ] = "",
    points: Annotated[
        str, typer.Argument(metavar="[POINTS]", help="A number, or auto for the automatic points.")
    ] = "",
    why: Why = "",
    table: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="CSV", help="A table of points: submission, a column per criterion."
        ),
    ] = None,
    assignment: Lab = None,
) -> None:
    """Give criteria points by hand; every later grading keeps them."""
    from pipeline.grading.gradebook.decisions import read_points

    if table is not None:
        if team or criterion or points:
            raise typer.BadParameter("give TEAM CRITERION POINTS, or --from, not both")
        return _override_from(grades, table, why=why, by=by, assignment=assignment)
    if not (team and criterion and points):
        raise typer.BadParameter("give TEAM, CRITERION and POINTS; or a table with --from")
    _change(grades, team, assignment, lambda book, name: book.override(
        name, criterion, read_points(points), why=why, by=by))  # fmt: skip


@app.command(context_settings={"ignore_unknown_options": True})
def adjust(
    grades: Grades,
    team: Team,
    points: Annotated[
        str, typer.Argument(metavar="POINTS", help="Points to add, such as 1.5; -2 deducts two.")
    ],
    why: Why,
    by: By,
    assignment: Lab = None,
) -> None:
    """Change a team's total, for a bonus or a penalty; every later grading keeps it."""
    from pipeline.grading.gradebook.decisions import read_points

    _change(grades, team, assignment, lambda book, name: book.adjust(
        name, read_points(points) or 0.0, why=why, by=by))  # fmt: skip


@app.command()
def hold(
    grades: Grades,
    by: By,
    team: Annotated[
        str, typer.Argument(metavar="[TEAM]", help="A submission, or one of its authors.")
    ] = "",
    criterion: Annotated[
        str, typer.Option(metavar="ID", help="A criterion, for the whole class.")
    ] = "",
    why: Annotated[str, typer.Option(help="The reason, for the staff.")] = "",
    end: Annotated[bool, typer.Option("--end", help="Hold it back no longer.")] = False,
    assignment: Lab = None,
) -> None:
    """Hold a team's grade, or a criterion, back from students; or, with --end, no longer."""
    from pipeline.grading.publish.pseudonyms import resolve_pseudonym

    if bool(team) == bool(criterion):
        raise typer.BadParameter("name either a team or a --criterion")
    with _changing(grades, assignment) as book:
        if criterion:
            book.hold_criterion(criterion, not end, why=why, by=by)
        elif end:
            book.let_go(resolve_pseudonym(book, team), by=by)
        else:
            book.hold(resolve_pseudonym(book, team), why=why, by=by)
    say(f"{team or criterion}: {'no longer ' if end else ''}held back")


def _change(
    grades: str,
    team: str,
    assignment: str | None,
    change: "Callable[[Gradebook, str], object]",
) -> None:
    """Change the points of a team, which may be a pseudonym, and say its new total."""
    from pipeline.grading.publish.pseudonyms import resolve_pseudonym

    with _changing(grades, assignment) as book:
        name = resolve_pseudonym(book, team)
        change(book, name)
        grade = book.entry(name).grade
    shown = grade.submission if name == team else team
    still = f"; not final: {', '.join(grade.open)} still open" if grade.open else ""
    say(f"{shown}: {grade.points:g} of {grade.out_of:g} points{still}")


def _override_from(grades: str, table: Path, *, why: str, by: str, assignment: str | None) -> None:
    """Change points from a table, either all of them or none."""
    from dataclasses import replace

    from pipeline.grading.gradebook.decisions import read_wishes
    from pipeline.grading.publish.pseudonyms import resolve_pseudonym
    from pipeline.words.numbers import count

    wishes = read_wishes(table, why=why)
    with _changing(grades, assignment) as book:
        named = []
        for wish in wishes:
            try:
                name = book.entry(resolve_pseudonym(book, wish.submission)).submission
            except ConfigError as error:
                raise ConfigError(f"{table.name} line {wish.line}: {error}") from None
            named.append(replace(wish, submission=name))
        done = book.change_all(named, by=by)
        left = sum(bool(entry.grade.open) for entry in book.entries())
    say(f"{count(done.teams, 'change')} of {count(len(wishes), 'cell')} in {table.name}")
    if left:
        say(f"not final: {count(left, 'submission')} with criteria that a person has to grade")


@app.command()
def remove(
    grades: Grades,
    teams: Annotated[
        list[str], typer.Argument(metavar="TEAM…", help="Names of submissions or authors.")
    ],
    assignment: Lab = None,
    erase: Annotated[
        bool, typer.Option("--erase", help="Delete all that is kept about them, for good.")
    ] = False,
) -> None:
    """Take submissions off the class list; their history stays, unless --erase deletes it."""
    from pipeline.grading.publish.pseudonyms import resolve_pseudonym

    if erase:
        _erase(grades, teams, assignment)
        return
    with _changing(grades, assignment) as book:
        names = {resolve_pseudonym(book, team): team for team in teams}
        by_hand = [team for name, team in names.items() if _by_hand(book, name)]
        gone = [names.get(name, name) for name in book.remove(list(names))]
    say(f"no longer in the class: {', '.join(gone)}")
    if by_hand:
        say(f"their points given by hand no longer count: {', '.join(by_hand)}")


def _by_hand(book: "Gradebook", name: str) -> bool:
    entry = book.entry(name)
    return bool(entry.overrides or entry.adjustments)


def _erase(grades: str, teams: list[str], assignment: str | None) -> None:
    """Delete submissions for good.

    The pages are written again without them. Earlier exports contain their names, so they are
    deleted.
    """
    from pipeline.grading.intake.repairs import forget_repairs
    from pipeline.grading.publish.export import remove_exports
    from pipeline.words.numbers import count

    with _changing(grades, assignment) as book:
        gone = book.erase(teams)
    folder = Path(grades).parent if Path(grades).is_file() else Path(grades)
    forget_repairs(folder, gone)
    say(f"erased: {', '.join(gone)}")
    if folder.is_dir() and (files := remove_exports(folder)):
        say(f"deleted {count(len(files), 'exported file')} that also contained them; export again")
    say(
        "not erased: the submitted folders, zip files in handed-in/, backups, and files that you "
        "copied elsewhere"
    )


@contextmanager
def _changing(grades: str, assignment: str | None) -> Iterator["Gradebook"]:
    """Open a gradebook to change it; if it is in a folder, update the pages there afterwards."""
    from pipeline.grading.gradebook.gradebook import Gradebook
    from pipeline.grading.publish.outputs import write_outputs
    from pipeline.lock import lock_or_refuse

    folder = Path(grades)
    with Gradebook(grades, assignment=assignment) as book:
        if not folder.is_dir():
            yield book
            return
        with lock_or_refuse(folder):
            yield book
            write_outputs(book, folder)


@app.command()
def history(grades: Grades, team: Team, assignment: Lab = None, as_json: AsJson = False) -> None:
    """Show every grade and change of a team, with who, when and why."""
    from pipeline.grading.gradebook.gradebook import Gradebook
    from pipeline.grading.gradebook.history import history_dict, history_text
    from pipeline.grading.publish.pseudonyms import history_of

    with Gradebook(grades, assignment=assignment) as book:
        submission, events = history_of(book, team)
    told = history_dict if as_json else history_text
    _show(told(submission, events))


def _show(found: str | dict[str, Any]) -> None:
    """Print a text, or a dictionary as JSON."""
    text = found if isinstance(found, str) else json.dumps(found, indent=1, ensure_ascii=False)
    typer.echo(text)


PlatformName = StrEnum("PlatformName", list(PLATFORMS))


@app.command("export")
def export_grades(
    grades: Annotated[
        str | None,
        typer.Argument(metavar="GRADES", help="The --out folder of `cartlab grade`, or a URL."),
    ] = None,
    lms: Annotated[PlatformName | None, typer.Option(help="The learning platform.")] = None,
    feedback: Annotated[
        bool, typer.Option("--feedback", help="Write the zip of feedback files instead.")
    ] = False,
    autograder: Annotated[
        Path | None,
        typer.Option(metavar="RUBRIC", help="Write an autograder zip for Gradescope instead."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A folder, or FILE.csv for the table alone, or FILE.zip with --feedback; "
            "default: GRADES. "
            "With --autograder: the zip; default: autograder.zip."
        ),
    ] = None,
    roster: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="The table exported from the platform, to fill in."),
    ] = None,
    title: Annotated[
        str | None,
        typer.Option(help="Title of the assignment on the platform; default: the rubric's."),
    ] = None,
    assignment: Lab = None,
) -> None:
    """Write grades or feedback for a learning platform, or Gradescope's autograder."""
    if autograder is not None:
        if grades or lms or feedback or roster or title or assignment:
            raise typer.BadParameter("--autograder takes only a rubric and --out")
        return _export_autograder(autograder, out or Path("autograder.zip"))
    if grades is None or lms is None:
        raise typer.BadParameter("give GRADES and --lms, or --autograder with a rubric")
    if feedback and title:
        raise typer.BadParameter("--title is the title of a table of grades, not of feedback")
    from pipeline.grading.gradebook.gradebook import Gradebook
    from pipeline.grading.publish.export import export, export_feedback

    folder, platform = Path(grades), PLATFORMS[lms.value]
    with Gradebook(grades, assignment=assignment) as book:
        to = out or (folder if folder.is_dir() else Path())
        if feedback:
            done = export_feedback(book, platform, to, roster=roster)
        else:
            done = export(book, platform, to, title=title, roster=roster)
    for remark in done.remarks:
        say(remark.text)
    first, *more = done.files
    say(f"wrote {first}" + (f" and {len(more)} more" if more else ""))
    if any(remark.left_out for remark in done.remarks):
        raise typer.Exit(1)


def _export_autograder(rubric: Path, out: Path) -> None:
    from pipeline.grading.gradescope import write_autograder

    for task in write_autograder(rubric, out):
        say(task)
    say(f"wrote {out}")


@app.command()
def survey(
    file: Annotated[Path, typer.Argument(metavar="CSV", help="Answers, one row per student.")],
    as_json: AsJson = False,
) -> None:
    """Make tables of opinions, knowledge and confidence from a questionnaire."""
    from pipeline.grading.publish.survey import read_survey, survey_dict, survey_text

    found = read_survey(file)
    if found.left_out:
        say(f"left out, because no table has these questions: {', '.join(found.left_out)}")
    _show(survey_dict(found) if as_json else survey_text(found))


@app.command("new-rubric")
def write_rubric(
    reference: Annotated[
        Path, typer.Option("--from", metavar="DIR", help="A submission folder, such as your own.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The rubric to write.")] = Path(
        "rubric.toml"
    ),
) -> None:
    """Write a rubric from a reference submission: what its recordings can decide."""
    from pipeline.grading.new_rubric import new_rubric
    from pipeline.output import write_file
    from pipeline.submission import load_submission
    from pipeline.words.numbers import count
    from pipeline.workflow import analyse

    if out.exists():
        raise ConfigError(f"{out}: exists already; choose another file with --out")
    submission = load_submission(reference)
    with progress_line() as progress:
        analysis = analyse(submission, design=False, progress=progress)
    if failed := len(analysis.failed_checks):
        say(f"{count(failed, 'check')} of the recordings failed; see `cartlab report {reference}`")
    new = new_rubric(submission, analysis, source=reference.resolve().name)
    write_file(out, new.text)
    for left_out in new.undecided:
        say(f"not asked: {left_out}")
    what = f"{len(new.rubric.criteria)} criteria"
    say(
        f"wrote {out}: {what}, {new.rubric.out_of:g} points; "
        f"try `cartlab check-rubric {out} --from {reference}`"
    )


@app.command("check-rubric")
def check_rubric(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A rubric file or shipped name.")],
    reference: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="DIR",
            help="Also grade simulated students who have the recordings of this submission.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Validate a rubric and show what it requires."""
    from pipeline.grading.rubric_file import load_rubric
    from pipeline.grading.rubric_text import rubric_dict, rubric_text

    rubric = load_rubric(file)
    shown = rubric_dict(rubric) if as_json else rubric_text(rubric)
    if reference is not None:
        from pipeline.grading.simulated_class import class_dict, class_text, simulate_class
        from pipeline.submission import load_submission

        submission = load_submission(reference)
        with progress_line() as progress:
            found = simulate_class(submission, rubric=rubric, progress=progress)
        if isinstance(shown, dict):
            shown["simulated"] = class_dict(found)
        else:
            shown += f"\n\n{class_text(found)}"
    _show(shown)
