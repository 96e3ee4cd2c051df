"""What decided a criterion, as the TA's page and the student's show it."""

from itertools import count

from pipeline.grading.grade import Criterion, Flag, Grade
from pipeline.grading.judge.costs import concerns
from pipeline.grading.publish.feedback import numbers_table, sentence
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.rubric import Rubric
from pipeline.report.document import paragraph
from pipeline.report.render.html import render_blocks
from pipeline.set_up import Units
from pipeline.words.text import rich


def show_evidence(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the message and the numbers, theirs beside ours, as HTML."""
    return show_message(criterion) + show_numbers(criterion, check, units)


def show_message(criterion: Criterion) -> str:
    """Return the criterion's message as HTML."""
    return render_blocks([paragraph(rich(sentence(criterion.message)))])


def show_numbers(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the numbers, theirs beside ours, as HTML; "" without numbers."""
    table = numbers_table(criterion, check=check, units=units, numbers=count(0))
    return render_blocks([table]) if table else ""


def find_remarks(grade: Grade, asked: Asked, rubric: Rubric) -> list[Flag]:
    """Return the remarks of a grade that are about a criterion."""
    return [flag for flag in grade.flags if is_about(flag, asked, rubric)]


def is_about(flag: Flag, asked: Asked, rubric: Rubric) -> bool:
    """Whether a remark is about a criterion; shared recordings are about none."""
    return flag.code != "shared_data" and concerns(flag, asked, names=rubric.names)
