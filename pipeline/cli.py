"""The `cartlab` command: parse, call one function, write, exit code.

Data goes to `--out` or stdout, talk to stderr. Exit 0 done, 1 done but checks failed, 2 cannot run.
Everything heavy is imported by the command that needs it, so that `--help` answers at once.
"""

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.exceptions import TyperException

from pipeline import __version__
from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pipeline.report.changes import DraftChanges
    from pipeline.results import Analysis

app = typer.Typer(
    name="cartlab",
    help="Lab reports and identification for carts on springs: from raw bench data to the plant, "
    "a controller and a report.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A submission folder.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def main() -> None:
    """Run the command line; an error that a person can act on is one line and exit status 2."""
    try:
        sys.exit(app(sys.argv[1:] or ["--help"], standalone_mode=False))
    except TyperException as error:  # a wrong option or argument
        _fail(f"{error.format_message()} (cartlab --help explains)")
    except PipelineError as error:
        _fail(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}: choose another place, for example with --out")


def _fail(message: str) -> None:
    say(f"cartlab: {message}")
    sys.exit(2)


def say(text: str) -> None:
    """Print to stderr: talk, never data."""
    typer.echo(text, err=True)


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Show what is being done while it is done; silent where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    text_column = TextColumn("{task.description}", markup=False)  # a record may be called "[b]"
    columns = SpinnerColumn(), text_column, TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("starting", total=None)
        yield lambda text: shown.update(task, description=text)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"cartlab {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where to write.")] = Path("cartlab-demo"),
) -> None:
    """Run the whole job: a shipped example, a bench that hides friction, a class of three."""
    from pipeline.output import check_folder
    from pipeline.resources import EXAMPLES

    _run_report(EXAMPLES / "three-cart", out=check_folder(out) / "report", pdf=True)
    bench = out / "bench"
    if not (bench / "submission.toml").exists():
        simulate(out=bench, preset="throne-2dof", hide=["coulomb_friction"])
    gap(bench, out=out / "gap")
    for number in (1, 2, 3):
        team = out / "class" / f"team-{number}"
        if not (team / "submission.toml").exists():
            simulate(out=team, preset="throne-1dof", seed=number, reported=True)
    grade([out / "class"], rubric=Path("throne-1dof"), out=out / "grades")


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to make.")],
    carts: Annotated[int, typer.Option(min=1, max=4, help="How many carts the bench has.")] = 1,
) -> None:
    """Write a commented submission folder to fill in."""
    from pipeline.submission import new_submission

    new_submission(folder, carts=carts)
    say(f"wrote {folder}: put your data files into {folder / 'data'} and fill in submission.toml")


@app.command()
def inspect(
    files: Annotated[list[Path], typer.Argument(metavar="FILE…", help="Data files.")],
    as_json: AsJson = False,
) -> None:
    """Show what a data file holds: format, columns, rate, duration, kind, problems."""
    from pipeline.ingest.inspect import format_inspection, inspect_file

    inspections, unreadable = [], []
    for file in files:  # one broken file does not hide the others
        try:
            inspections.append(inspect_file(file))
        except PipelineError as error:
            unreadable.append(str(error))
    if as_json:
        typer.echo(json.dumps([i.to_dict() for i in inspections], indent=1, ensure_ascii=False))
    elif inspections:
        typer.echo("\n\n".join(format_inspection(i) for i in inspections))
    for message in unreadable:
        say(f"cartlab: {message}")
    if unreadable:
        raise typer.Exit(2)


@app.command()
def report(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/report.")] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="RESULTS", help="An earlier results.json: say what changed."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Identify the carts, design the controller, check the hardware, write the report."""
    analysis = _run_report(folder, out=out, pdf=pdf, compare=compare)
    if as_json:
        from pipeline.results_json import results_text

        typer.echo(results_text(analysis), nl=False)
    failed = [check for check in analysis.checks if check.outcome == "fail"]
    if failed:
        raise typer.Exit(1)


def _run_report(
    folder: Path, *, out: Path | None, pdf: bool, compare: Path | None = None
) -> "Analysis":
    from pipeline.output import check_folder, own_folder, write_file
    from pipeline.report.changes import changes_line
    from pipeline.report.known_gap import with_gap
    from pipeline.report.questions import open_line
    from pipeline.report.render import render_report
    from pipeline.report.summary import terminal_summary
    from pipeline.results_json import results_text
    from pipeline.submission import load_submission
    from pipeline.workflow import analyse

    submission = load_submission(folder)
    out = check_folder(out) if out else own_folder(submission.folder, "report")
    compared = _comparison(compare)
    with _progress() as progress:
        analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
        changes = compared(analysis)
        out.mkdir(parents=True, exist_ok=True)
        write_file(out / "results.json", results_text(analysis))
        render_report(analysis, out, gap=gap, changes=changes, pdf=pdf, progress=progress)
    say(terminal_summary(analysis))
    for line in (changes and changes_line(changes), open_line(analysis)):
        if line:
            say(line)
    say(f"wrote {out / 'report.html'}" + (f" and {out / 'report.pdf'}" if pdf else ""))
    return analysis


def _comparison(earlier: Path | None) -> "Callable[[Analysis], DraftChanges | None]":
    """Return what compares an analysis with an earlier draft, which is read at once."""
    if earlier is None:
        return lambda analysis: None
    from pipeline.report.compare import compare_drafts, read_results

    return partial(compare_drafts, read_results(earlier))


@app.command()
def solution(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/solution.")] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    as_json: AsJson = False,
) -> None:
    """Write the instructor's reference: derivations, numbers put in, what to expect."""
    from pipeline.output import check_folder, own_folder, write_file
    from pipeline.report.known_gap import with_gap
    from pipeline.report.solution import render_solution, solution_text
    from pipeline.submission import load_submission
    from pipeline.workflow import analyse

    submission = load_submission(folder)
    out = check_folder(out) if out else own_folder(submission.folder, "solution")
    with _progress() as progress:
        analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
        out.mkdir(parents=True, exist_ok=True)
        write_file(out / "solution.json", text := solution_text(analysis))
        render_solution(analysis, out, gap=gap, pdf=pdf, progress=progress)
    say(f"wrote {out / 'solution.html'}" + (f" and {out / 'solution.pdf'}" if pdf else ""))
    if as_json:
        typer.echo(text, nl=False)


@app.command()
def gap(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/gap.")] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    as_json: AsJson = False,
) -> None:
    """Find what the linear model leaves out, name it, and show the gap shrink on held-out runs."""
    from pipeline.gap.stored import gap_text
    from pipeline.output import check_folder, own_folder, write_file
    from pipeline.report.gap import render_gap
    from pipeline.report.words_gap import terminal_verdict
    from pipeline.submission import load_submission
    from pipeline.workflow import analyse

    submission = load_submission(folder)
    out = check_folder(out) if out else own_folder(submission.folder, "gap")
    with _progress() as progress:
        analysis = analyse(submission, progress=progress)
        from pipeline.gap.investigate import investigate  # loads the compiled simulator

        found = investigate(analysis, progress=progress)
        out.mkdir(parents=True, exist_ok=True)
        write_file(out / "gap.json", text := gap_text(found, analysis))
        render_gap(found, analysis, out, pdf=pdf, progress=progress)
    say(f"{terminal_verdict(found)}\nwrote {out / 'gap.html'}")
    if as_json:
        typer.echo(text, nl=False)


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="The submission folder to write.")],
    preset: Annotated[
        str | None, typer.Option(help="throne-1dof, throne-2dof or throne-3dof.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="A gap.json whose chain and effects to simulate.")
    ] = None,
    hide: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT[:key=value,…]", help="Hide an effect (see `cartlab effects`); repeat."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed: same seed, same bytes.")] = 0,
    reported: Annotated[
        bool, typer.Option("--reported", help="Add what an honest student would report.")
    ] = False,
) -> None:
    """Write a synthetic submission: decays, steps, sine dwells, a sweep, a closed-loop step."""
    from pipeline.output import new_folder
    from pipeline.synthesis.hidden import prepare_bench, write_bench

    new_folder(out)
    bench = prepare_bench(preset=preset, model=model, hide=hide or ())
    for sentence in bench.told:
        say(f"hidden: {sentence}")
    with _progress() as progress:
        progress("simulating the experiments")
        write_bench(out, bench, seed=seed, reported=reported)
    say(f"wrote {out}: try `cartlab report {out}`")


@app.command()
def grade(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH…", help="Submission folders, trees of them, or zip files."),
    ],
    rubric: Annotated[Path, typer.Option(metavar="FILE", help="A rubric, or a shipped name.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the gradebook is or will be.")],
    jobs: Annotated[int, typer.Option(min=1, help="Processes; default: one a core.")] = (
        os.cpu_count() or 1
    ),
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:PORT.")
    ] = None,
    time_limit: Annotated[float, typer.Option(min=1, help="s for each submission.")] = 120.0,
    memory_limit: Annotated[float, typer.Option(min=0.1, help="GB for each submission.")] = 1.0,
    figures: Annotated[
        bool, typer.Option("--figures/--no-figures", help="Draw those of the feedback.")
    ] = True,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Leave names out; anonymous-key.csv reveals them.")
    ] = False,
    gradebook: Annotated[
        str | None,
        typer.Option(metavar="URL", help="A database; default: gradebook.sqlite in --out."),
    ] = None,
) -> None:
    """Grade a class: gradebook, grades.csv, a page of the class, feedback for each student."""
    from pipeline.grading.batch_run import grade_class
    from pipeline.grading.runner import Limits

    with _batch_progress() as progress:
        done = grade_class(
            paths,
            rubric_file=rubric,
            out=out,
            jobs=jobs,
            cluster=cluster,
            limits=Limits(time=time_limit, memory=round(memory_limit * 1e9)),
            figures=figures,
            progress=progress,
            anonymous=anonymous,
            gradebook=gradebook,
        )
    for submission, reason in done.failed:
        say(f"{submission}: {reason}")
    shared = f", {done.sharing} with recordings that another has too" if done.sharing else ""
    say(f"{done.total - len(done.failed)} of {done.total} graded{shared}; wrote {out}")
    if done.failed:
        raise typer.Exit(1)


@contextmanager
def _batch_progress() -> Iterator[Callable[[int, int, str], None]]:
    """Show how many are done and how long the others will take; silent where nobody looks."""
    if not sys.stderr.isatty():
        yield lambda done, total, last: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        MofNCompleteColumn(),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),  # a submission may be called "[b]"
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("opening", total=None)
        yield lambda done, total, last: shown.update(
            task, completed=done, total=total, description=last
        )


Grades = Annotated[
    str, typer.Argument(metavar="GRADES", help="The --out folder of `cartlab grade`, or a URL.")
]
Team = Annotated[str, typer.Argument(metavar="TEAM", help="A submission, or one of its authors.")]
Lab = Annotated[
    str | None,
    typer.Option("--assignment", help="A rubric's name, where the gradebook has several."),
]


@app.command()
def override(
    grades: Grades,
    team: Team,
    criterion: Annotated[str, typer.Argument(metavar="CRITERION", help="Its id in the rubric.")],
    points: Annotated[
        str, typer.Argument(metavar="POINTS", help="A number, or auto: the automatic ones again.")
    ],
    why: Annotated[str, typer.Option(help="The reason, which the student reads.")],
    by: Annotated[str, typer.Option(metavar="NAME", help="Who says so.")],
    assignment: Lab = None,
) -> None:
    """Give a criterion points by hand, which every later grading keeps."""
    from pipeline.grading.gradebook import Gradebook
    from pipeline.grading.outputs import write_outputs
    from pipeline.grading.override import read_points

    with Gradebook(grades, assignment=assignment) as book:
        book.override(team, criterion, read_points(points), why=why, by=by)
        folder = Path(grades)
        if folder.is_dir():
            write_outputs(book, folder)
        grade = book.entry(team).grade
    say(f"{grade.submission}: {grade.points:g} of {grade.out_of:g} points")


@app.command()
def history(grades: Grades, team: Team, assignment: Lab = None, as_json: AsJson = False) -> None:
    """Show every grade and change of a team, with who, when and why."""
    from pipeline.grading.gradebook import Gradebook
    from pipeline.grading.history import history_dict, history_text

    with Gradebook(grades, assignment=assignment) as book:
        submission, events = book.history(team)
    if as_json:
        typer.echo(json.dumps(history_dict(submission, events), indent=1, ensure_ascii=False))
    else:
        typer.echo(history_text(submission, events))


class Platform(StrEnum):
    """A learning platform."""

    CANVAS = "canvas"
    MOODLE = "moodle"
    GRADESCOPE = "gradescope"


@app.command("export")
def export_grades(
    grades: Grades,
    lms: Annotated[Platform, typer.Option(help="The learning platform.")],
    out: Annotated[Path | None, typer.Option(help="Where to write; default: GRADES.")] = None,
    roster: Annotated[
        Path | None, typer.Option(metavar="CSV", help="The platform's own table, to be filled in.")
    ] = None,
    title: Annotated[
        str | None, typer.Option(help="Of the assignment there; default: the rubric's.")
    ] = None,
    assignment: Lab = None,
) -> None:
    """Write the class grades for import into a learning platform."""
    from pipeline.grading.export import export
    from pipeline.grading.gradebook import Gradebook
    from pipeline.output import check_folder

    folder = Path(grades)
    with Gradebook(grades, assignment=assignment) as book:
        to = check_folder(out or (folder if folder.is_dir() else Path()))
        done = export(book, lms.value, to, title=title, roster=roster)
    for remark in done.remarks:
        say(remark)
    first, *more = done.files
    say(f"wrote {first}" + (f" and {len(more)} more" if more else ""))


@app.command()
def survey(
    file: Annotated[Path, typer.Argument(metavar="CSV", help="Answers, a row a student.")],
    as_json: AsJson = False,
) -> None:
    """Make the tables of opinions and of knowledge and confidence from a questionnaire."""
    from pipeline.grading.survey import read_survey, survey_dict, survey_text

    found = read_survey(file)
    if found.left_out:
        say(f"left out, no question of either table: {', '.join(found.left_out)}")
    if as_json:
        typer.echo(json.dumps(survey_dict(found), indent=1, ensure_ascii=False))
    else:
        typer.echo(survey_text(found))


@app.command("check-rubric")
def check_rubric(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A rubric, or a shipped name.")],
    as_json: AsJson = False,
) -> None:
    """Validate a rubric and show what it asks of a submission."""
    from pipeline.grading.describe import rubric_dict, rubric_text
    from pipeline.grading.load import load_rubric

    rubric = load_rubric(file)
    if as_json:
        typer.echo(json.dumps(rubric_dict(rubric), indent=1, ensure_ascii=False))
    else:
        typer.echo(rubric_text(rubric))


@app.command()
def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect; default: all.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write effects.html here, with pictures of each.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List what a bench may do beyond the linear chain: law, fingerprint, what decides."""
    from pipeline.plant.effects import CATALOGUE, find_effect
    from pipeline.report.words_effects import catalogue_data, catalogue_text

    chosen = [find_effect(name)] if name else CATALOGUE
    if out:
        from pipeline.output import check_folder
        from pipeline.report.effects import render_effects

        with _progress() as progress:
            render_effects(chosen, check_folder(out), progress=progress)
        say(f"wrote {out / 'effects.html'}")
    if as_json:
        typer.echo(json.dumps(catalogue_data(chosen), indent=1, ensure_ascii=False))
    elif not out:
        typer.echo(catalogue_text(chosen))


@app.command()
def schema(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="results, gap or solution.")
    ] = "results",
) -> None:
    """Print the JSON Schema of results.json, gap.json or solution.json."""
    from pipeline.schemas.export import schema_text

    typer.echo(schema_text(name), nl=False)
