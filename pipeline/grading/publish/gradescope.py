"""Write a grade as the `results.json` of a Gradescope autograder.

Keys and values are those of Gradescope's *Autograder Specifications*.

If students must find the numbers themselves (`see = "check"`), they see no computed number. Because
they may resubmit, and partial points would reveal the error of a number, they see points only after
the due date.
"""

import json

from pipeline.grading.grade import Criterion
from pipeline.grading.publish.view import GradeView
from pipeline.grading.words import WORDS
from pipeline.words.text import with_symbols


def results_text(view: GradeView) -> str:
    """Return a grade as `results.json`; the same grade gives the same bytes."""
    grade = view.grade
    document = {
        "score": grade.points,
        "output": "\n".join(_grade_lines(view)),
        "output_format": "text",
        "test_output_format": "text",
        "test_name_format": "text",
        "stdout_visibility": "hidden",
        "tests": [
            {
                "score": judged.points,
                "max_score": judged.out_of,
                **_status(judged, view),
                "name": judged.title or judged.id,
                "number": str(number),
                "output": _criterion_text(judged, view),
                "tags": [judged.id],
                "visibility": "after_due_date" if view.hides_numbers else "visible",
            }
            for number, judged in enumerate(grade.criteria, start=1)
        ],
        "extra_data": {"flags": [flag.code for flag in grade.flags]},
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _grade_lines(view: GradeView) -> list[str]:
    """Return the lines that students see about the whole grade."""
    how = " automatically, so points were given by hand" if view.is_by_hand else ""
    if view.grade.status == "failed":
        lines = [f"Could not be graded{how}: {view.grade.reason}"]
    else:
        lines = [WORDS.text("gradescope_hidden")] if view.hides_numbers else []
    return [*lines, *view.flag_lines(), *view.total_lines()]


def _status(judged: Criterion, view: GradeView) -> dict[str, str]:
    """Return the status of a criterion; without one, Gradescope compares its points."""
    if judged.id in view.grade.open:
        return {}
    return {"status": "passed" if judged.outcome == "pass" else "failed"}


def _criterion_text(judged: Criterion, view: GradeView) -> str:
    """Return the text that students see about a criterion."""
    why = "; ".join(map(with_symbols, view.reasons(judged)))
    return ": ".join([WORDS.text(f"outcome_{judged.outcome}"), *([why] if why else [])])
