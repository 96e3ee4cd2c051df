"""From a submission to its reference in a folder: what `cartlab solution` and the desk do."""

from collections.abc import Callable
from pathlib import Path

from pipeline.output import write_file
from pipeline.report.gap.section import with_gap
from pipeline.report.solution.write import render_solution, solution_text
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.workflow import analyse


def make_solution(
    submission: Submission, out: Path, *, pdf: bool = True, progress: Callable[[str], None]
) -> tuple[Analysis, str]:
    """Analyse a submission, write its reference; return the analysis and solution.json."""
    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "solution.json", text := solution_text(analysis))
    render_solution(analysis, out, gap=gap, pdf=pdf, progress=progress)
    return analysis, text
