"""What the desk's worker does, by name: JSON in, JSON out."""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.desk.class_tasks import publish, regrade
from pipeline.desk.exercises import effect_svg, exercise, simulate, solution
from pipeline.desk.last_report import ASKED, sources
from pipeline.errors import ConfigError, SubmissionError
from pipeline.identify.springs import fill as fill_folder
from pipeline.ingest.columns import assign_columns
from pipeline.ingest.fill import Found, data_files, has_fractions, look_at, passed_over
from pipeline.ingest.formats.recognise import read_table
from pipeline.lock import alone_in
from pipeline.output import own_folder, write_file
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.submission.load import leaves

Progress = Callable[[str], None]
_ACROSS, _HIGH = 120, 32  # of a thumbnail


def look(
    folder: str, file: str, columns: dict[str, str | int], *, progress: Progress
) -> dict[str, Any]:
    """Return what a data file is, with a thumbnail; `columns` as `submission.toml` states them."""
    if leaves(Path(folder), file):
        raise SubmissionError(f"{file}: leaves the folder")
    found = look_at(Path(folder), file, columns=columns)
    return {**_plain(found), "lines": thumbnail(Path(folder), found, columns=columns)}


def files(folder: str, *, progress: Progress) -> list[str]:
    """Return the data files that there are."""
    return data_files(Path(folder))


def not_read(folder: str, named: list[str], *, progress: Progress) -> list[dict[str, str]]:
    """Return the files that are not looked into, with what to do; those `named` have a table."""
    found = passed_over(Path(folder), named=named)
    return [{"file": one.file, "reason": one.remarks[0], "advice": one.advice} for one in found]


def fill(folder: str, *, progress: Progress) -> list[dict[str, Any]]:
    """Write the tables of the files in `data/`."""
    return [_plain(found) for found in fill_folder(Path(folder)).files]


def report(folder: str, *, progress: Progress) -> dict[str, Any]:
    """Write the report into the submission's own folder, compared with the one that was there."""
    from pipeline.report.draft.changes import changes_line, compare_drafts, read_results
    from pipeline.report.draft.write import make_report
    from pipeline.report.sections.housekeeping import taken_text
    from pipeline.report.sections.questions import ask
    from pipeline.report.words import with_symbols

    made_of = sources(Path(folder))  # before it is read: what changes meanwhile is not in it
    submission = load_submission(Path(folder))
    out = own_folder(submission.folder, "report")

    def compared(analysis: Analysis) -> Any:
        try:
            return compare_drafts(read_results(out / "results.json"), analysis)
        except ConfigError:  # none, or of another bench
            return None

    with alone_in(out):
        analysis, changes = make_report(submission, out, compared=compared, progress=progress)
        asked = [
            {"id": question.id, "text": with_symbols(question.text)} for question in ask(analysis)
        ]
        told = {
            "questions": asked,
            "assumed": [
                {
                    "key": one.key,
                    "about": one.about,
                    "taken": taken_text(one),
                    "why": with_symbols(one.reason),
                }
                for one in analysis.assumptions
                if one.origin != "stated"
            ],
            "changes": with_symbols(changes_line(changes)) if changes else "",
            "failed": [with_symbols(check.message) for check in analysis.failed_checks],
            "unreadable": dict(analysis.unreadable),
            "made_of": made_of,
        }
        write_file(out / ASKED, json.dumps(told, ensure_ascii=False))
    return told


def gap(folder: str, *, progress: Progress) -> None:
    """Write what the linear model leaves out into the submission's own folder."""
    from pipeline.bench.design.discriminate import propose_for
    from pipeline.gap.investigate import investigate
    from pipeline.gap.stored import gap_text
    from pipeline.report.gap.page import render_gap
    from pipeline.workflow import analyse

    submission = load_submission(Path(folder))
    out = own_folder(submission.folder, "gap")
    with alone_in(out):
        analysis = analyse(submission, design=False, progress=progress)
        found = investigate(analysis, progress=progress)
        found = propose_for(found, submission)
        write_file(out / "gap.json", gap_text(found, analysis))
        render_gap(found, analysis, out, progress=progress)


def unpack(archive: str, into: str, *, progress: Progress) -> list[str]:
    """Unpack what was uploaded, by the limits of a hand-in; return the files."""
    from pipeline.grading.intake.unpack import HAND_IN, unpack

    target = Path(into)
    shutil.rmtree(target, ignore_errors=True)
    if refused := unpack(Path(archive), target, limits=HAND_IN):
        raise SubmissionError(next(iter(refused.values())))
    return sorted(p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file())


def plan(folder: str, stock: bool, *, progress: Progress) -> str:
    """Write plan.toml, or add to it what the data allow; return why they allow nothing."""
    from pipeline.bench.planning.propose import make_plan

    made = make_plan(load_submission(Path(folder)), stock=stock, progress=progress)
    return made.trouble or "done"


def weigh(
    folder: str, recording: dict[str, Any], goal: str, *, progress: Progress
) -> dict[str, Any]:
    """Return what a recording would bring, beside the one that would be chosen."""
    from pipeline.bench.design.next_plan import known_commands
    from pipeline.bench.design.weigh import weigh as weighed
    from pipeline.bench.planning.plan import Recording
    from pipeline.bench.planning.plan_words import what_words
    from pipeline.bench.planning.propose import current_plan
    from pipeline.workflow import analyse

    submission = load_submission(Path(folder))
    found = weighed(
        analyse(submission, progress=progress),
        Recording.model_validate_json(json.dumps(recording)),
        current_plan(submission),
        goal=goal,
        commands=known_commands(submission.folder),
    )
    chosen = what_words(found.chosen, submission)
    return {**asdict(found), "chosen": chosen}


TASKS: Mapping[str, Callable[..., Any]] = {
    "look": look,
    "files": files,
    "not_read": not_read,
    "fill": fill,
    "report": report,
    "gap": gap,
    "unpack": unpack,
    "plan": plan,
    "weigh": weigh,
    "exercise": exercise,
    "effect_svg": effect_svg,
    "simulate": simulate,
    "solution": solution,
    "publish": publish,
    "regrade": regrade,
}


def _plain(found: Found) -> dict[str, Any]:
    inspection = found.inspection
    return {
        "file": found.file,
        "state": found.state,
        "kind": found.kind,
        "remarks": list(found.remarks),
        "unsure": list(found.unsure),
        "fractions": has_fractions(found),
        "format": inspection.format if inspection else "",
        "duration": inspection.duration if inspection else None,
    }


def thumbnail(folder: Path, found: Found, *, columns: Mapping[str, str | int]) -> list[str]:
    """Return the positions of a record as the points of SVG lines, one a cart."""
    if found.inspection is None or found.kind == "bode":
        return []
    table, _ = read_table(folder, found.file)
    stated = {role: column for role, column in columns.items() if table.has(column)}
    explicit = stated or found.inspection.guessed
    assigned, _ = assign_columns(table, explicit=explicit, free=(1,))
    roles = sorted(role for role in assigned if role[0] == "x")
    rows = [table.values[assigned[role].index] for role in roles]
    low = min((float(row.min()) for row in rows), default=0.0)
    high = max((float(row.max()) for row in rows), default=0.0)
    if not np.isfinite(high - low) or high == low:
        return []
    return [_points((row - low) / (high - low)) for row in rows]


def _points(row: Array) -> str:
    """Return a row between 0 and 1 as points: least and most of every stretch, in turn."""
    stretches = np.array_split(row, min(row.size, _ACROSS))
    heights = [(s.max(), s.min())[i % 2] for i, s in enumerate(stretches)]
    step = _ACROSS / max(len(heights) - 1, 1)
    return " ".join(f"{i * step:.1f},{_HIGH * (1 - h):.1f}" for i, h in enumerate(heights))
