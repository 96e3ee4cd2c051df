"""The evidence for the points of a criterion, as the pages of TAs and students show it."""

from itertools import count

from pipeline.grading.grade import Criterion
from pipeline.grading.publish.feedback import numbers_table, sentence
from pipeline.report.document import paragraph
from pipeline.report.html import render_blocks
from pipeline.setup import Units
from pipeline.words.text import rich


def show_evidence(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the message, and the reported numbers next to the recomputed ones, as HTML."""
    return show_message(criterion) + show_numbers(criterion, check, units)


def show_message(criterion: Criterion) -> str:
    """Return the message of a criterion as HTML."""
    return render_blocks([paragraph(rich(sentence(criterion.message)))])


def show_numbers(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the reported numbers next to the recomputed ones as HTML; "" without numbers."""
    table = numbers_table(criterion, check=check, units=units, numbers=count(0))
    return render_blocks([table]) if table else ""
