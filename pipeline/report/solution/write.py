"""The instructor's solution: the report with derivations and with numbers inserted."""

from dataclasses import replace
from pathlib import Path

from pipeline.gap.types import Gap
from pipeline.grading.rubric import Rubric
from pipeline.output import write_file
from pipeline.report.builder import Part
from pipeline.report.document import Document, Paragraph, paragraph
from pipeline.report.files import write_document
from pipeline.report.gap_files import with_gap
from pipeline.report.lab_report import build_document
from pipeline.report.sections.questions import Asked
from pipeline.report.solution.expected import (
    check_carts,
    default_rubric,
    expected_blocks,
    solution_text,
)
from pipeline.report.solution.worked import (
    design_blocks,
    motion_blocks,
    state_blocks,
    transfer_blocks,
)
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.words.numbers import count
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import Span, rich
from pipeline.workflow import analyse

_WORDS = phrases("solution")


def make_solution(
    submission: Submission,
    out: Path,
    *,
    rubric: Rubric | None = None,
    pdf: bool = True,
    progress: Progress,
) -> tuple[Analysis, str]:
    """Analyse a submission and write its solution; return the analysis and solution.json.

    Parameters
    ----------
    rubric : the rubric that states the ranges; by default, the shipped one for this number of
        carts.

    Raises
    ------
    ConfigError : the rubric is for another number of carts.
    """
    if rubric is not None:
        check_carts(rubric, carts=submission.system.carts)
    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "solution.json", text := solution_text(analysis, rubric=rubric))
    render_solution(analysis, out, rubric=rubric, gap=gap, pdf=pdf, progress=progress)
    return analysis, text


def render_solution(
    analysis: Analysis,
    out: Path,
    *,
    rubric: Rubric | None = None,
    gap: Gap | None = None,
    pdf: bool = True,
    progress: Progress = silent,
) -> None:
    """Write `solution.html`, `solution.pdf` and `figures/*.svg` into the folder `out`."""
    document = build_solution(analysis, rubric=rubric, gap=gap, progress=progress)
    write_document(document, out, name="solution", pdf=pdf)


def build_solution(
    analysis: Analysis,
    *,
    rubric: Rubric | None = None,
    gap: Gap | None = None,
    progress: Progress = silent,
) -> Document:
    """Return the report with derivations in place of the short sections on the model.

    It contains no text of students: their notes are left out, and each question has a model answer.
    """
    accepted = rubric or default_rubric(analysis)
    worked: tuple[Part, ...] = (
        ("motion", "Equations of motion", motion_blocks),
        ("transfer-functions", "Transfer functions", transfer_blocks),
        ("state-model", "From the table to the state model", state_blocks),
        ("worked-design", "The controller, worked", design_blocks),
        (
            "expected",
            "What to expect in a submission",
            lambda page: expected_blocks(page, accepted),
        ),
    )
    document = build_document(
        analysis, gap=gap, worked=worked, answer=model_answer, progress=progress
    )
    parts = ["Worked solution for instructors", count(analysis.bench.n, "cart")]
    if analysis.failed_checks:
        parts.append(f"doubtful: {count(len(analysis.failed_checks), 'check')} failed")
    return replace(document, subtitle=" · ".join(parts))


def model_answer(question: Asked) -> Paragraph:
    """Return a paragraph with a good answer to a question."""
    lead = Span(_WORDS.text("model_answer"), "strong")
    return paragraph(lead, rich(_WORDS.text(f"answer_{question.kind}")))
