"""What decided a criterion, as several pages show it."""

from itertools import count

from pipeline.grading.grade import Criterion
from pipeline.grading.publish.feedback import numbers_table, sentence
from pipeline.report.document import paragraph
from pipeline.report.render.html import render_blocks
from pipeline.set_up import Units
from pipeline.words.text import rich


def show_evidence(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return what was said and the numbers, theirs beside ours, as HTML."""
    table = numbers_table(criterion, check=check, units=units, numbers=count(0))
    said = paragraph(rich(sentence(criterion.message)))
    return render_blocks([said, *([table] if table else [])])
