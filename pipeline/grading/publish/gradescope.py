"""Write a grade as the `results.json` of a Gradescope autograder.

Keys and values are those of Gradescope's *Autograder Specifications*.

If students must find the numbers themselves (`see = "check"`), they see no computed number. Because
they may resubmit, and partial points would reveal the error of a number, they see points only after
the due date.
"""

import json
from collections.abc import Collection

from pipeline.grading.grade import CODES, Code, Criterion, Grade
from pipeline.grading.judge.costs import find_remarks
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.flag import student_message
from pipeline.grading.words import WORDS, person_lines, points_text
from pipeline.words.text import with_symbols

# Flags whose text has no computed numbers.
_WITHOUT_NUMBERS: tuple[Code, ...] = ("missing", "shared_data")


def results_text(grade: Grade, *, rubric: Rubric, by_hand: bool = False) -> str:
    """Return a grade as `results.json`; the same grade gives the same bytes."""
    hidden = rubric.students.see == "check"
    document = {
        "score": grade.points,
        "output": "\n".join(_grade_lines(grade, by_hand=by_hand, hidden=hidden)),
        "output_format": "text",
        "test_output_format": "text",
        "test_name_format": "text",
        "stdout_visibility": "hidden",
        "tests": [
            {
                "score": judged.points,
                "max_score": judged.out_of,
                **_status(judged, grade),
                "name": judged.title or judged.id,
                "number": str(number),
                "output": _criterion_text(judged, grade, rubric, hidden=hidden),
                "tags": [judged.id],
                "visibility": "after_due_date" if hidden else "visible",
            }
            for number, judged in enumerate(grade.criteria, start=1)
        ],
        "extra_data": {"flags": [flag.code for flag in grade.flags]},
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def flag_messages(grade: Grade, *, codes: Collection[Code] = CODES) -> list[str]:
    """Return the text that students see for each flag with one of these codes."""
    return [with_symbols(student_message(flag)) for flag in grade.flags if flag.code in codes]


def _grade_lines(grade: Grade, *, by_hand: bool, hidden: bool) -> list[str]:
    """Return the lines that students see about the whole grade.

    Parameters
    ----------
    hidden : whether to show no computed number.
    """
    how = " automatically, so points were given by hand" if by_hand else ""
    failed = grade.status == "failed"
    lines = [f"Could not be graded{how}: {grade.reason}"] if failed else []
    if hidden:
        lines += [] if failed else [WORDS.text("gradescope_hidden")]
    lines += flag_messages(grade, codes=_WITHOUT_NUMBERS if hidden else CODES)
    late = [f"Late: {points_text(grade.deducted)} points off."] if grade.deducted else []
    return [*lines, *late, *person_lines(grade)]


def _status(judged: Criterion, grade: Grade) -> dict[str, str]:
    """Return the status of a criterion; without one, Gradescope compares its points."""
    if judged.id in grade.open:
        return {}
    return {"status": "passed" if judged.outcome == "pass" else "failed"}


def _criterion_text(judged: Criterion, grade: Grade, rubric: Rubric, *, hidden: bool) -> str:
    """Return the text that students see about a criterion.

    Parameters
    ----------
    hidden : whether to show only the outcome, the titles of the flags, and the reasons for points
        given by hand.
    """
    outcome = WORDS.text(f"outcome_{judged.outcome}")
    if not hidden:
        return f"{outcome}: {with_symbols(judged.message)}"
    lines = [
        WORDS.text(f"title_{flag.code}")
        for criterion in rubric.criteria
        if criterion.id == judged.id
        for flag in find_remarks(grade, criterion, rubric)
    ]
    lines += [given.why for given in grade.overrides if given.criterion == judged.id]
    return ": ".join([outcome, "; ".join(lines)] if lines else [outcome])
