"""Commands of reports and models.

From raw data to a report: new, inspect, fill, report, check, solution, gap. Of models: simulate,
effects, schema.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli.common import (
    AsJson,
    Folder,
    Hide,
    Model,
    Preset,
    app,
    progress_line,
    say,
    say_briefly,
)
from pipeline.errors import PipelineError
from pipeline.second_process import SecondProcess
from pipeline.words.progress import Progress

if TYPE_CHECKING:
    from pipeline.report.changes import DraftChanges
    from pipeline.report.make_report import Files
    from pipeline.results import Analysis
    from pipeline.submission import Submission


_MOST_LINES = 17  # of the summary of a report; the lines on files and status come after it


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to create.")],
    carts: Annotated[int, typer.Option(min=1, max=4, help="How many carts the bench has.")] = 1,
) -> None:
    """Write a commented submission folder to fill in."""
    from pipeline.submission import new_submission

    new_submission(folder, carts=carts)
    say(f"wrote {folder}: put your data files into {folder / 'data'} and fill in submission.toml")


@app.command()
def inspect(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE…|DIR", help="Data files, or folders of them.")
    ],
    as_json: AsJson = False,
) -> None:
    """Show what data files hold: format, columns, rate, duration, kind, problems.

    For a folder (its data/, if there is one) it shows a table with one line per file.
    """
    from pipeline.ingest.files import data_files_in, files_not_read, not_read_notes
    from pipeline.ingest.inspect import (
        format_inspection,
        format_inspections,
        inspect_runs,
        unread_entry,
    )

    inspections, entries, unreadable = [], [], []
    columns: dict[Path, Mapping[str, str | int]] = {}
    folders = [
        file / "data" if (file / "data").is_dir() else file for file in files if file.is_dir()
    ]
    listed = [file for file in files if not file.is_dir()]
    for folder in folders:
        found = data_files_in(folder)
        listed += found
        if not found:
            unreadable.append(f"{folder}: contains no data files")
        columns |= dict.fromkeys(found, _stated_columns(folder))
    with progress_line() as progress:
        for file in listed:  # a broken file must not hide the others
            progress(f"reading {file.name}")
            try:
                runs = inspect_runs(file, columns=columns.get(file, {}))
                inspections += runs
                entries += [one.to_dict() for one in runs]
            except PipelineError as error:
                unreadable.append(str(error))
                entries.append(unread_entry(file, "broken", str(error)))
    not_read: list[tuple[str, str, str]] = []
    for folder in folders:
        for one in files_not_read(folder, root=folder):
            not_read.append(((Path(folder.name) / one.file).as_posix(), one.reason, one.advice))
            entries.append(
                unread_entry(folder / one.file, "not_read", one.reason, advice=one.advice)
            )
    if as_json:
        typer.echo(json.dumps(entries, indent=1, ensure_ascii=False))
    elif inspections and folders:
        typer.echo(format_inspections(inspections))
    elif inspections:
        typer.echo("\n\n".join(format_inspection(i) for i in inspections))
    for message in (*unreadable, *not_read_notes(not_read)):
        say(f"cartlab: {message}")
    if unreadable or any(one.unusable for one in inspections):
        raise typer.Exit(1 if inspections else 2)


def _stated_columns(data: Path) -> "Mapping[str, str | int]":
    """Return the columns that the submission of a data folder states, if it can be read."""
    from pipeline.submission import load_submission

    for folder in (data, data.parent):
        with suppress(PipelineError):
            return load_submission(folder).system.columns
    return {}


@app.command()
def fill(folder: Folder, as_json: AsJson = False) -> None:
    """Find out what the files in DIR/data are and add their entries to submission.toml."""
    from pipeline.identify.springs import fill_folder
    from pipeline.ingest.fill import format_found, format_passed_over

    toml = folder / "submission.toml"
    before = toml.read_bytes() if toml.is_file() else None
    with progress_line() as progress:
        progress("finding out what the files are")
        filled = fill_folder(folder)
    found = filled.files
    if as_json:
        typer.echo(json.dumps([f.to_dict() for f in found], indent=1, ensure_ascii=False))
    else:
        typer.echo(format_found(found))
    left = [f for f in found if f.state in ("unknown", "broken", "missing", "refused")]
    did = "nothing to add to" if toml.read_bytes() == before else "wrote"
    say(f"{did} {toml}: check springs, units and everything marked unsure")
    for message in (*filled.doubts, *format_passed_over(found)):
        say(f"cartlab: {message}")
    gone = [f.file for f in left if f.state == "missing"]
    unused = [f.file for f in left if f.state != "missing"]
    spoilt = [f.file for f in found if f.inspection and f.inspection.unusable]
    if gone:
        say(f"cartlab: there is no such file: {', '.join(gone)}")
    if unused:
        say(f"cartlab: not used yet: {', '.join(unused)}")
    if spoilt := [file for file in spoilt if file not in unused]:
        say(f"cartlab: a report cannot use these files as they are: {', '.join(spoilt)}")
    if left or spoilt:
        raise typer.Exit(1)


@app.command()
def report(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/report.")] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="RESULTS", help="An earlier results.json: show what changed."),
    ] = None,
    tables: Annotated[
        bool, typer.Option("--tables", help="Write tables/*.csv and, for MATLAB, results.mat too.")
    ] = False,
    plots: Annotated[
        bool,
        typer.Option("--plots", help="Write compare.html too: plots of all recordings and models."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Identify the carts, design the controller, check the hardware, write the report."""
    from pipeline.report.make_report import Files

    files = Files(pdf=pdf, tables=tables, plots=plots)
    analysis = run_report(folder, out=out, files=files, compare=compare)
    if as_json:
        from pipeline.json_files import json_text

        typer.echo(json_text(analysis), nl=False)
    if not analysis.status.is_fine:
        raise typer.Exit(1)


def run_report(
    folder: Path,
    *,
    out: Path | None,
    files: "Files",
    compare: Path | None = None,
) -> "Analysis":
    """Write the report of a submission and print a short summary.

    A second process loads what draws the report while this one loads what analyses the data. The
    desk shows a report in the submission's own folder as one of its own.
    """
    with SecondProcess("pipeline.report.lab_report", "make_draft") as second:
        from pipeline.desk.last_report import stat_sources, write_findings
        from pipeline.output import named_folder, own_folder
        from pipeline.report.make_report import make_report

        # Note the state before the files are read, so that the desk notices a later change.
        made_of = stat_sources(folder if folder.is_dir() else folder.parent)
        submission = _load(folder)
        own = own_folder(submission.folder, "report")
        out = named_folder(out) if out else own
        compared = _comparison(compare, submission)
        with progress_line() as progress:
            analysis, draft = make_report(
                submission, out, compared=compared, make=second.do, files=files, progress=progress
            )
        if out.resolve() == own.resolve():
            write_findings(draft.findings, out, made_of=made_of)
    page = out / "report.html"
    told = [draft.summary, *_unreadable(analysis), *draft.remarks]
    say_briefly("\n".join(told), most=_MOST_LINES, more=str(page))
    say(_wrote(out, "report", pdf=files.pdf))
    if files.plots:
        say(f"wrote {out / 'compare.html'}")
    say(f"status: {analysis.status.words}")
    return analysis


def _load(folder: Path) -> "Submission":
    """Read a submission, and tell which reported numbers cannot be read."""
    from pipeline.submission import load_submission

    submission = load_submission(folder)
    for part in submission.unread:
        say(f"cartlab: not used, because it cannot be read: {part.message}")
    return submission


def _unreadable(analysis: "Analysis") -> list[str]:
    reasons = [f"- {name}: {reason}" for name, reason in analysis.unreadable.items()]
    return ["Not read.", *reasons] if reasons else []


def _comparison(
    earlier: Path | None, submission: "Submission"
) -> "Callable[[Analysis], DraftChanges | None]":
    """Return a function that compares an analysis with an earlier draft.

    The draft is read before the long analysis, so that an unusable one is refused at once.
    """
    if earlier is None:
        return lambda analysis: None
    from pipeline.report.changes import check_comparable, compare_drafts, read_results

    before = read_results(earlier)
    check_comparable(before, bench=submission.system.bench)
    return partial(compare_drafts, before)


@app.command()
def check(
    folder: Folder,
    rubric: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The rubric that sets the tolerances: a file or shipped name."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List your numbers that disagree with your recordings; if asked again, say where to look.

    The right value is never shown. DIR/checks.jsonl, part of your submission, counts the checks.
    """
    from pipeline.grading.rubric_file import load_rubric
    from pipeline.grading.self_check.answers import answer_line, answer_lines
    from pipeline.grading.self_check.check import check_numbers
    from pipeline.submission import load_submission

    asked = load_rubric(rubric) if rubric else None
    with progress_line() as progress:
        answer = check_numbers(load_submission(folder), rubric=asked, progress=progress)
    typer.echo(answer_line(answer) if as_json else "\n".join(answer_lines(answer)), nl=not as_json)
    if answer.disagree:
        raise typer.Exit(1)


@app.command()
def solution(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/solution.")] = None,
    rubric: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The rubric that sets the accepted ranges; default: the shipped one.",
        ),
    ] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    as_json: AsJson = False,
) -> None:
    """Write the instructor's solution: derivations with numbers and expected values."""
    from pipeline.grading.rubric_file import load_rubric
    from pipeline.output import named_folder, own_folder
    from pipeline.report.solution.write import make_solution
    from pipeline.words.text import with_symbols

    submission, asked = _load(folder), load_rubric(rubric) if rubric else None
    out = named_folder(out) if out else own_folder(submission.folder, "solution")
    with progress_line() as progress:
        analysis, text = make_solution(submission, out, rubric=asked, pdf=pdf, progress=progress)
    failed = [f"cartlab: {with_symbols(check.message)}" for check in analysis.failed_checks]
    for line in failed:  # unreadable files are among these lines
        say(line)
    doubtful = "; it is doubtful, because the checks above failed" if analysis.failed_checks else ""
    say(_wrote(out, "solution", pdf=pdf) + doubtful)
    if as_json:
        typer.echo(text, nl=False)
    if doubtful:
        raise typer.Exit(1)


@app.command()
def gap(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="Where to write; default: DIR/gap.")] = None,
    budget: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Time limit of the search, after which it gives the best answer so far. "
            "Without a limit the answer is the same on every computer.",
        ),
    ] = None,
    pdf: Annotated[bool, typer.Option("--pdf/--no-pdf", help="Write the PDF too.")] = True,
    model: Annotated[
        bool,
        typer.Option(
            "--model", help="Write the model for other programs: model.fmu, model.c, model.m."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find and name what the linear model leaves out, and test it on held-out recordings."""
    with progress_line() as progress:
        text, told = explain(
            folder, out=out, budget=budget, pdf=pdf, model=model, progress=progress
        )
    for line in told:
        say(line)
    if as_json:
        typer.echo(text, nl=False)


def explain(
    folder: Path,
    *,
    out: Path | None,
    budget: float | None = None,
    pdf: bool = True,
    model: bool = False,
    progress: Progress,
) -> tuple[str, list[str]]:
    """Write the gap analysis of a submission; return the text of gap.json and the messages."""
    with SecondProcess("pipeline.report.gap_report", "make_gap_files") as second:
        from pipeline.json_files import json_text
        from pipeline.output import named_folder, own_folder
        from pipeline.report.gap_files import make_gap, save_model

        submission = _load(folder)
        out = named_folder(out) if out else own_folder(submission.folder, "gap")
        found, analysis = make_gap(
            submission, out, make=second.do, budget=budget, pdf=pdf, progress=progress
        )
    from pipeline.report.gap_verdict import terminal_verdict

    told = []
    if model:
        unseen = {i for r in analysis.records for i in r.free if i not in r.carts}
        free = unseen | {row.cart for row in found.by_record}
        told.append(save_model(found.model, analysis, out, free=free))
    wrote = _wrote(out, "gap", pdf=pdf)
    return json_text(found), [*_unreadable(analysis), terminal_verdict(found), wrote, *told]


def _wrote(out: Path, name: str, *, pdf: bool) -> str:
    return f"wrote {out / f'{name}.html'}" + (f" and {out / f'{name}.pdf'}" if pdf else "")


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="The submission folder to write.")],
    preset: Preset = None,
    model: Model = None,
    hide: Hide = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed: same seed, same bytes.")] = 0,
    reported: Annotated[
        bool, typer.Option("--reported", help="Add the numbers an honest student would report.")
    ] = False,
    vary: Annotated[
        float | None,
        typer.Option(
            metavar="PERCENT", help="Draw a bench for one team, within ± PERCENT; needs --secret."
        ),
    ] = None,
    secret: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The answer key: a secret, and the true values by team."),
    ] = None,
) -> None:
    """Write a synthetic submission: decays, steps, sine dwells, a sweep, a closed-loop step."""
    if (vary is None) != (secret is None):
        raise typer.BadParameter("--vary and --secret belong together")
    from pipeline.output import new_folder
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.submission import write_submission

    new_folder(out)
    prepare = partial(prepare_bench, preset=preset, model=model, hide=hide or ())
    if vary is not None and secret is not None:
        from pipeline.grading.true_bench import write_team

        with progress_line() as progress:
            write_team(
                out, lambda rng: prepare(rng=rng), percent=vary, key=secret, seed=seed,
                reported=reported, progress=progress,
            )  # fmt: skip
        say(f"wrote {out}, and its true values to {secret}")
        return
    bench = prepare()
    for sentence in bench.effect_sentences:
        say(f"hidden: {sentence}")
    with progress_line() as progress:
        progress("simulating the experiments")
        write_submission(out, bench, seed=seed, reported=reported)
    say(f"wrote {out}: try `cartlab report {out}`")


@app.command()
def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect; default: all.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write effects.html, with pictures, to this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the effects beyond the linear chain: law, fingerprint, deciding experiment."""
    from pipeline.plant.catalogue import CATALOGUE, find_effect
    from pipeline.report.effect_texts import catalogue_data, catalogue_text

    chosen = [find_effect(name)] if name else CATALOGUE
    if out:
        from pipeline.output import named_folder
        from pipeline.report.effects import render_effects

        with progress_line() as progress:
            render_effects(chosen, named_folder(out), progress=progress)
        say(f"wrote {out / 'effects.html'}")
    if as_json:
        typer.echo(json.dumps(catalogue_data(chosen), indent=1, ensure_ascii=False))
    elif not out:
        typer.echo(catalogue_text(chosen))


@app.command()
def schema(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="results, gap, solution, grade, check or rubric.")
    ] = "results",
) -> None:
    """Print the JSON Schema of a result file, of a check, or of a rubric."""
    from pipeline.schemas import schema_text

    typer.echo(schema_text(name), nl=False)
