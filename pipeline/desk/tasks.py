"""Tasks that the desk runs in worker processes; only these processes read other people's files."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.desk.exercises import (
    check_exercise,
    describe_hidden,
    draw_effect,
    make_exercises,
    make_solution,
)
from pipeline.desk.form_input import keep_refusal, read_path
from pipeline.desk.last_report import PLOTS_OF, stat_sources, write_findings
from pipeline.desk.student.folder_tasks import FOLDER_TASKS
from pipeline.errors import ConfigError, SubmissionError
from pipeline.identify.springs import fill_folder
from pipeline.ingest.channels import never_changes
from pipeline.ingest.columns import assign_columns
from pipeline.ingest.files import OF_STRANGERS, read_table
from pipeline.ingest.fill import (
    Found,
    data_files,
    examine_runs,
    passed_over,
)
from pipeline.ingest.read import read_data
from pipeline.lock import lock_or_refuse
from pipeline.output import own_folder, write_file
from pipeline.processes import serve
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.submission.load import parse_readable, path_problem
from pipeline.words.progress import Progress

_ACROSS, _HIGH = 120, 32  # width and height of a thumbnail


def describe_file(
    folder: str, file: str, columns: dict[str, str | int], *, progress: Progress
) -> dict[str, Any]:
    """Return what a data file contains, with a thumbnail.

    Parameters
    ----------
    columns : columns of the file, as `submission.toml` states them.
    """
    if path_problem(Path(folder), file):
        raise SubmissionError(f"{file}: is outside the folder")
    found = examine_runs(Path(folder), file, columns=columns)[0]
    return {**_describe(found), "lines": draw_thumbnail(Path(folder), found, columns=columns)}


def list_files(folder: str, *, progress: Progress) -> list[str]:
    """Return the names of the existing data files."""
    return data_files(Path(folder))


def list_not_read(folder: str, named: list[str], *, progress: Progress) -> list[dict[str, str]]:
    """Return the files that are not read, and for each, why and what to do about it.

    Parameters
    ----------
    named : files that have a table in `submission.toml`.
    """
    found = passed_over(Path(folder), named=named)
    return [{"file": one.file, "reason": one.remarks[0], "advice": one.advice} for one in found]


def fill_tables(folder: str, *, progress: Progress) -> list[dict[str, Any]]:
    """Add tables for the files in `data/`; return what was found in each file."""
    return [_describe(found) for found in fill_folder(Path(folder)).files]


def make_report(folder: str, *, progress: Progress) -> dict[str, Any]:
    """Write the report into the submission's folder, and compare it with the previous one."""
    from pipeline.report.changes import compare_drafts, read_results
    from pipeline.report.lab_report import make_draft
    from pipeline.report.make_report import make_report as write_report

    # Note the state before the files are read, so that a later change is noticed.
    made_of = stat_sources(Path(folder))
    submission = load_submission(Path(folder))
    out = own_folder(submission.folder, "report")

    def compared(analysis: Analysis) -> Any:
        try:
            return compare_drafts(read_results(out / "results.json"), analysis)
        except ConfigError:  # there is no previous report, or it is of another bench
            return None

    with lock_or_refuse(out):
        _, draft = write_report(
            submission, out, compared=compared, make=make_draft, progress=progress
        )
        return write_findings(draft.findings, out, made_of=made_of)


def make_gap(folder: str, *, progress: Progress) -> None:
    """Write the report on the gap into the submission's folder."""
    from pipeline.report.gap_files import make_gap as write_gap
    from pipeline.report.gap_report import make_gap_files

    submission = load_submission(Path(folder))
    out = own_folder(submission.folder, "gap")
    with lock_or_refuse(out):
        write_gap(submission, out, make=make_gap_files, progress=progress)


def make_plots(folder: str, *, progress: Progress) -> None:
    """Write the page of plots into the submission's folder, next to its report."""
    from pipeline.report.compare import write_plots
    from pipeline.report.gap_files import with_gap
    from pipeline.workflow import analyse

    # Note the state before the files are read, as for a report.
    made_of = stat_sources(Path(folder))
    submission = load_submission(Path(folder))
    out = own_folder(submission.folder, "report")
    with lock_or_refuse(out):
        analysis, gap = with_gap(
            analyse(submission, design=False, progress=progress), submission.folder
        )
        write_plots(analysis, out, gap=gap, progress=progress)
        write_file(submission.folder / PLOTS_OF, json.dumps({"made_of": made_of}))


def check_numbers(folder: str, rubric: str, where: list[str], *, progress: Progress) -> None:
    """Check the reported numbers, or find where to look for some; write to checks.jsonl."""
    from pipeline.grading.rubric_file import load_rubric
    from pipeline.grading.self_check.check import check_numbers as check

    asked = load_rubric(Path(rubric)) if rubric else None
    check(load_submission(Path(folder)), rubric=asked, where=where, progress=progress)


def propose_recordings(folder: str, stock: bool, *, progress: Progress) -> str:
    """Write plan.toml, or add recordings to it; return the reason if nothing can be planned."""
    from pipeline.experiments.propose import make_plan

    _, trouble = make_plan(load_submission(Path(folder)), stock=stock, progress=progress)
    return trouble or "done"


def weigh_recording(
    folder: str, recording: dict[str, Any], goal: str, *, progress: Progress
) -> dict[str, Any]:
    """Return how much a typed recording would reduce the error, and how much the best one would."""
    from pipeline.bench.raw import known_commands
    from pipeline.experiments.next_recordings import compare_recordings
    from pipeline.experiments.plan import Recording, what_words
    from pipeline.experiments.propose import current_plan
    from pipeline.workflow import analyse

    submission = load_submission(Path(folder))
    best, after, why = compare_recordings(
        analyse(submission, progress=progress),
        Recording.model_validate(recording),
        current_plan(submission),
        goal=goal,
        commands=known_commands(submission.folder),
    )
    return {
        "words": best.words,
        "now": best.now,
        "proposed": after,
        "why": why,
        "chosen": what_words(best.recordings[0], submission),
        "best": best.errors[-1],
    }


def describe_exercise(
    bench: dict[str, str], hide: list[str], folder: str, *, progress: Progress
) -> dict[str, Any]:
    """Return a finished exercise: what is hidden, its files, and the first record of each kind."""
    submission = load_submission(Path(folder))
    first = {record.kind: record for record in reversed(read_data(submission).records)}
    return {
        "sentences": describe_hidden(bench, hide),
        "files": data_files(Path(folder)),
        "records": [
            {"id": record.id, "kind": record.kind, "lines": _draw_lines(list(record.y))}
            for record in reversed(first.values())
        ],
    }


def publish_grades(folder: str, *, progress: Progress) -> None:
    """Write the output files of the gradebook in a folder."""
    from pipeline.grading.gradebook.gradebook import Gradebook
    from pipeline.grading.publish.outputs import write_outputs
    from pipeline.lock import lock_or_refuse

    out = Path(folder)
    progress("pages and feedback")
    with Gradebook(out) as book, lock_or_refuse(out):
        write_outputs(book, out)


def check_grading(
    files: Sequence[str],
    paths: Sequence[str],
    rubric: str,
    lateness: str,
    skip: str,
    *,
    progress: Progress,
) -> dict[str, str]:
    """Return why a grading cannot start, by field of its form.

    Zip files that cannot be graded are no reason, unless there is nothing else.

    Parameters
    ----------
    files : uploaded archives.
    skip : folder of the class, whose content is not graded; "" if there is no such folder.
    """
    from pipeline.grading.intake.find import check_hand_ins, read_late_table
    from pipeline.grading.rubric_file import load_rubric

    wrong: dict[str, str] = {}
    broken: dict[str, str] = {}
    n_good = 0
    for name, given in (("files", files), ("paths", paths)):
        with keep_refusal(name, wrong):
            for path in given:
                if why := check_hand_ins(Path(path), skip=[Path(skip)] if skip else []):
                    broken.setdefault(name, why)
                else:
                    n_good += 1
    wrong |= {} if n_good else broken | wrong
    with keep_refusal("rubric", wrong):
        if not rubric:
            raise ConfigError("choose a rubric, or enter a file")
        load_rubric(Path(rubric))
    with keep_refusal("lateness", wrong):
        if lateness:
            read_late_table(Path(lateness))
    return wrong


def grade_submissions(
    folder: str,
    paths: Sequence[str],
    rubric: str,
    lateness: str,
    options: Mapping[str, Any],
    *,
    progress: Progress,
) -> str:
    """Grade a class into a folder; for an anonymous class, progress messages name no team.

    Parameters
    ----------
    options : see `intake.repairs.Run`.
    """
    from pipeline.grading.batch.grade_class import Options, grade_class

    anonymous = options.get("anonymous", False)
    try:
        done = grade_class(
            [read_path(path, wanted="enter the submissions") for path in paths],
            rubric_file=Path(rubric),
            out=Path(folder),
            options=Options(
                jobs=os.cpu_count() or 1,
                lateness=Path(lateness) if lateness else None,
                **options,
            ),
            progress=lambda done, total, last: progress(f"{done} of {total}"),
        )
    except ConfigError:
        if anonymous:
            raise ConfigError(
                "it could not start; run cartlab grade in a terminal to see why"
            ) from None
        raise
    return "; ".join([done.counted, *(() if anonymous else done.remarks)])


def render_notes(folder: str, *, progress: Progress) -> str:
    """Return a team's `notes.md` as HTML; "" without notes. No text in it is markup."""
    from pipeline.report.document import paragraph
    from pipeline.report.html import render_blocks
    from pipeline.report.sections.notes import even_headings, note_blocks
    from pipeline.submission.load import load_notes

    progress("reading the notes")
    try:
        blocks = even_headings(note_blocks(load_notes(Path(folder)) or ""))
    except SubmissionError as error:
        blocks = (paragraph(f"The notes cannot be shown: {error}"),)
    return str(render_blocks(blocks))


def check_repair(folder: str, text: str, *, progress: Progress) -> None:
    """Check a repaired `submission.toml`; whether its files exist, grading finds out.

    Parameters
    ----------
    folder : folder of the team's repairs.

    Raises
    ------
    SubmissionError : the text is not a valid submission.
    """
    parse_readable(text, folder=Path(folder))


def preview_rubric(folder: str, text: str, *, progress: Progress) -> dict[str, Any]:
    """Return the points of a graded class under a different rubric; see `RubricPreview`."""
    from pipeline.grading.gradebook.gradebook import Gradebook
    from pipeline.grading.publish.rubric_preview import preview_rubric as preview
    from pipeline.grading.rubric_file import parse_rubric

    rubric = parse_rubric(text, where="the rubric")
    with Gradebook(folder) as book:
        return asdict(preview(book, rubric, progress=progress))


def simulate_students(folder: str, text: str, *, progress: Progress) -> str:
    """Return what simulated students with a folder's recordings would get, as a table."""
    from pipeline.grading.rubric_file import parse_rubric
    from pipeline.grading.simulated_class import class_text, simulate_class

    rubric = parse_rubric(text, where="the rubric")
    submission = load_submission(Path(folder))
    return class_text(simulate_class(submission, rubric=rubric, progress=progress))


TASKS: Mapping[str, Callable[..., Any]] = {
    task.__name__: task
    for task in (
        *FOLDER_TASKS, describe_file, list_files, list_not_read, fill_tables, make_report, make_gap,
        check_numbers, propose_recordings, weigh_recording, publish_grades, check_grading,
        grade_submissions,
        preview_rubric, simulate_students, check_exercise, draw_effect, make_exercises,
        make_solution, describe_exercise, make_plots, render_notes, check_repair,
    )
}  # fmt: skip


def do(task: tuple[str, Mapping[str, Any]], progress: Progress) -> Any:
    """Run a task and return its answer.

    Parameters
    ----------
    task : name and arguments of the task.
    """
    name, arguments = task
    if not (folder := arguments.get("folder")):
        return TASKS[name](**arguments, progress=progress)
    # Messages then name files relative to this folder, so that they hold no path of a server.
    with chdir(Path(folder).parent):
        inside = Path(folder).name or "."
        return TASKS[name](**{**arguments, "folder": inside}, progress=progress)


def _describe(found: Found) -> dict[str, Any]:
    inspection = found.inspection
    return {
        "file": found.file,
        "state": found.state,
        "kind": found.kind,
        "remarks": list(found.remarks),
        "unusable": inspection.unusable if inspection else (),
        "unsure": list(found.unsure),
        "hardly": inspection.hardly_moving if inspection else (),
        "still": {
            cart: never_changes(column.name)
            for cart, column in (inspection.positions if inspection else {}).items()
            if column.low == column.high
        },
        "needs": inspection.needs if inspection else (),
        "frequency": inspection.frequency if inspection else None,
        "fractions": found.has_fractions,
        "format": inspection.format if inspection else "",
        "duration": inspection.duration if inspection else None,
    }


def draw_thumbnail(folder: Path, found: Found, *, columns: Mapping[str, str | int]) -> list[str]:
    """Return the positions of a record as points of SVG lines, one line per cart."""
    if found.inspection is None or found.kind == "bode":
        return []
    table, _ = read_table(folder, found.file)
    stated = {role: column for role, column in columns.items() if table.has(column)}
    explicit = stated or found.inspection.guessed
    assigned, _ = assign_columns(table, explicit=explicit, free=(1,))
    roles = sorted(role for role in assigned if role[0] == "x")
    return _draw_lines([table.values[assigned[role].index] for role in roles])


def _draw_lines(rows: Sequence[Array]) -> list[str]:
    """Return each row as the points of an SVG line; all lines have the same scale."""
    low = min((float(row.min()) for row in rows), default=0.0)
    high = max((float(row.max()) for row in rows), default=0.0)
    if not np.isfinite(high - low) or high == low:
        return []
    return [_write_points((row - low) / (high - low)) for row in rows]


def _write_points(row: Array) -> str:
    """Return values from 0 to 1 as points: alternately the maximum and minimum of a stretch."""
    stretches = np.array_split(row, min(row.size, _ACROSS))
    heights = [(s.max(), s.min())[i % 2] for i, s in enumerate(stretches)]
    step = _ACROSS / max(len(heights) - 1, 1)
    return " ".join(f"{i * step:.1f},{_HIGH * (1 - h):.1f}" for i, h in enumerate(heights))


if __name__ == "__main__":
    OF_STRANGERS.set(True)
    serve(lambda: do)
