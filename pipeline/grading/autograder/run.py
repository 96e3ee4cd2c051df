"""Grade the one submission of a Gradescope container: `run_autograder` calls this.

The folders are those of Gradescope's *Autograder Specifications*, below whatever root is named.
"""

import sys
import tempfile
from pathlib import Path

from pipeline.grading.batch.runner import Grader
from pipeline.grading.batch.worker import Setup, Task
from pipeline.grading.grade import read_grade
from pipeline.grading.publish.gradescope import results_text
from pipeline.grading.rubric_file import load_rubric
from pipeline.output import write_file

_TIME_LIMIT = 420.0  # s of the 600 that Gradescope gives; the rest is for starting


def grade_upload(root: Path) -> str:
    """Grade `submission/`, write `results/results.json`; return what the instructor may look up."""
    rubric = load_rubric(root / "source" / "rubric.toml")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        setup = Setup(rubric=rubric, scratch=Path(scratch), time_limit=_TIME_LIMIT)
        grader = Grader(setup)
        try:
            # Lateness is Gradescope's own affair, which knows extensions.
            task = Task(id="submission", key="", sources=(str(root / "submission"),))
            grading = grader.run(task)
        finally:
            grader.close()
    text = results_text(read_grade(grading.grade), rubric=rubric)
    write_file(root / "results" / "results.json", text)
    return grading.detail


if __name__ == "__main__":
    sys.stdout.write(grade_upload(Path(sys.argv[1])))
