"""From a submission to its report in a folder: what `cartlab report` and the desk do."""

from collections.abc import Callable
from pathlib import Path

from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.draft.changes import DraftChanges
from pipeline.report.draft.write import render_report
from pipeline.report.gap.section import with_gap
from pipeline.results import Analysis
from pipeline.results_json import results_text
from pipeline.submission import Submission
from pipeline.workflow import analyse


def make_report(
    submission: Submission,
    out: Path,
    *,
    compared: Callable[[Analysis], DraftChanges | None],
    pdf: bool = True,
    tables: bool = False,
    progress: Callable[[str], None],
) -> tuple[Analysis, DraftChanges | None]:
    """Analyse a submission, write its report, and return both and what changed.

    Parameters
    ----------
    compared : what an earlier draft had otherwise; asked before that is written over.
    """
    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    changes = compared(analysis)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "results.json", results_text(analysis))
    clear_files(out, "results.mat")  # of an earlier report
    clear_files(own_folder(out, "tables"), "*.csv")
    if tables:
        from pipeline.exchange.saved import save_tables  # loads pandas

        save_tables(analysis, out)
    render_report(analysis, out, gap=gap, changes=changes, pdf=pdf, progress=progress)
    return analysis, changes
