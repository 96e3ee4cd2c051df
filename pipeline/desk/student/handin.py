"""The zip that is handed in: what the submission names, and nothing else."""

import io
import zipfile
from pathlib import Path

from pipeline.desk.last_report import state
from pipeline.submission import load_submission
from pipeline.submission.load import NAME, outside

_FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # same files, same bytes
_REPORT = "report/report.pdf"
BESIDE = ("notes.md", _REPORT)


def hand_in(folder: Path) -> bytes:
    """Return the zip of a submission.

    Raises
    ------
    SubmissionError : it is not valid, or a file that it names is not there.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in held(folder):
            info = zipfile.ZipInfo(name, _FIXED_TIME)
            archive.writestr(info, (folder / name).read_bytes(), zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def held(folder: Path) -> list[str]:
    """Return the files that the zip holds.

    Raises
    ------
    SubmissionError : the submission is not valid.
    """
    files = [experiment.file for experiment in load_submission(folder).experiments]
    return list(dict.fromkeys([NAME, *files, *beside(folder)]))


def beside(folder: Path) -> list[str]:
    """Return what goes with it: of `BESIDE`, what is there; no report of what was changed since."""
    left_out = "" if state(folder) == "current" else _REPORT
    return [name for name in BESIDE if name != left_out and outside(folder, name) is None]


def missing(folder: Path) -> list[str]:
    """Return what keeps a submission from being handed in, each in a line."""
    submission = load_submission(folder)
    files = dict.fromkeys(experiment.file for experiment in submission.experiments)
    found = [problem for file in files if (problem := outside(folder, file)) is not None]
    return found or ([] if files else ["there is no experiment in it yet"])
