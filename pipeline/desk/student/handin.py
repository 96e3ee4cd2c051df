"""The files to hand in: those that the submission names, and nothing else.

Only workers call this, because it reads the submission.
"""

import os
from pathlib import Path

from pipeline.desk.last_report import NOTES, find_state
from pipeline.errors import SubmissionError
from pipeline.grading.self_check.answers import FILE as CHECKS
from pipeline.submission import load_submission
from pipeline.submission.load import NAME, file_problem

_REPORT = "report/report.pdf"
BESIDE = (NOTES, CHECKS, _REPORT)
_MADE = ("report", "gap", "solution")  # folders of computed results, which contain no recordings


def list_held(folder: Path, *, report: bool = True) -> list[str]:
    """Return the names of the files in the zip.

    Raises
    ------
    SubmissionError : the submission is not valid.
    """
    named = [experiment.file for experiment in load_submission(folder).experiments]
    files = [file for file in named if not _is_made(folder, file)]
    return list(dict.fromkeys([NAME, *files, *list_beside(folder, report=report)]))


def list_beside(folder: Path, *, report: bool = True) -> list[str]:
    """Return which files of `BESIDE` go into the zip; an outdated report is left out."""
    left_out = "" if report and find_state(folder) == "current" else _REPORT
    return [name for name in BESIDE if name != left_out and file_problem(folder, name) is None]


def list_missing(folder: Path) -> list[str]:
    """Return the reasons why a submission cannot be handed in."""
    try:
        submission = load_submission(folder)
    except SubmissionError as error:
        return [str(error)]
    files = dict.fromkeys(experiment.file for experiment in submission.experiments)
    found = [problem for file in files if (problem := file_problem(folder, file)) is not None]
    found += [
        f"{file} is computed from recordings; use the recording itself"
        for file in files
        if _is_made(folder, file)
    ]
    return found or ([] if files else ["it has no experiments yet"])


def _is_made(folder: Path, name: str) -> bool:
    """Return whether a file, or the target of its link, is in a folder of computed results."""
    root = folder.resolve()
    places = (Path(os.path.normpath(root / name)), (folder / name).resolve())
    return any(place.is_relative_to(root / made) for place in places for made in _MADE)
