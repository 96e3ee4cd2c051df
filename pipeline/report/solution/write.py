"""The instructor's reference: the report, with the derivations and the numbers put in."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pipeline.gap.types import Gap
from pipeline.output import write_file
from pipeline.report.document import Document
from pipeline.report.draft.content import Part, build_document
from pipeline.report.gap.section import with_gap
from pipeline.report.numbers import count
from pipeline.report.render.write import write_document
from pipeline.report.solution.design import design_blocks
from pipeline.report.solution.expected import expected_blocks, solution_text
from pipeline.report.solution.model import motion_blocks, state_blocks, transfer_blocks
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.workflow import analyse

_WORKED: tuple[Part, ...] = (
    ("motion", "Equations of motion", motion_blocks),
    ("transfer-functions", "Transfer functions", transfer_blocks),
    ("state-model", "From the table to the state model", state_blocks),
    ("worked-design", "The controller, worked", design_blocks),
    ("expected", "What to expect of a hand-in", expected_blocks),
)


def make_solution(
    submission: Submission, out: Path, *, pdf: bool = True, progress: Callable[[str], None]
) -> tuple[Analysis, str]:
    """Analyse a submission, write its reference; return the analysis and solution.json."""
    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "solution.json", text := solution_text(analysis))
    render_solution(analysis, out, gap=gap, pdf=pdf, progress=progress)
    return analysis, text


def render_solution(
    analysis: Analysis,
    out: Path,
    *,
    gap: Gap | None = None,
    pdf: bool = True,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write `solution.html`, `solution.pdf` and `figures/*.svg` into the folder `out`."""
    document = build_solution(analysis, gap=gap, progress=progress)
    write_document(document, out, name="solution", pdf=pdf)


def build_solution(
    analysis: Analysis, *, gap: Gap | None = None, progress: Callable[[str], None] | None = None
) -> Document:
    """Return the report with the worked sections in the place of the short ones on the model."""
    document = build_document(analysis, gap=gap, worked=_WORKED, progress=progress)
    told = ["Worked reference for instructors", count(analysis.carts, "cart")]
    if analysis.failed_checks:
        told.append(f"doubtful: {count(len(analysis.failed_checks), 'check')} failed")
    return replace(document, subtitle=" · ".join(told))
