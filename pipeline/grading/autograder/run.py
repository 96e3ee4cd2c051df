"""Grade the submission in a Gradescope container; the script `run_autograder` runs this module.

Gradescope's *Autograder Specifications* prescribe the names of the folders below `root`.
"""

import sys
import tempfile
from pathlib import Path

from pipeline.grading.batch.runner import Grader
from pipeline.grading.batch.task import Setup, Task
from pipeline.grading.grade import read_grade
from pipeline.grading.publish.gradescope import results_text
from pipeline.grading.publish.view import new_view
from pipeline.grading.rubric_file import load_rubric
from pipeline.output import write_file

_TIME_LIMIT = 420.0  # s; Gradescope stops after 600 s, including the start of the container


def grade_upload(root: Path) -> str:
    """Grade `submission/` and write `results/results.json`; return the traceback of a grader error.

    Gradescope shows the returned text only to the instructor; it is "" if there was no error.
    """
    rubric = load_rubric(root / "source" / "rubric.toml")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        setup = Setup(rubric=rubric, scratch=Path(scratch), time_limit=_TIME_LIMIT)
        grader = Grader(setup)
        try:
            # The task has no lateness: Gradescope knows the extensions and deducts points itself.
            task = Task(id="submission", key="", sources=(str(root / "submission"),))
            grading = grader.run(task)
        finally:
            grader.close()
    text = results_text(new_view(read_grade(grading.grade), rubric))
    write_file(root / "results" / "results.json", text)
    return grading.detail


if __name__ == "__main__":
    sys.stdout.write(grade_upload(Path(sys.argv[1])))
