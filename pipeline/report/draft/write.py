"""From a submission to its report in a folder: what `cartlab report` and the desk do."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pipeline.gap.types import Gap
from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.draft.changes import DraftChanges
from pipeline.report.draft.content import build_document
from pipeline.report.gap.section import with_gap
from pipeline.report.render.pdf import missing_characters
from pipeline.report.render.write import write_document
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


def render_report(
    analysis: Analysis,
    out: Path,
    *,
    gap: Gap | None = None,
    changes: DraftChanges | None = None,
    pdf: bool = True,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write `report.html`, `report.pdf` and `figures/*.svg` into the folder `out`.

    The same analysis gives the same bytes. What the PDF's fonts cannot show is warned of, in the
    report and through `progress`, which is also told of each section.
    """
    if pdf and (lost := missing_characters(_students_text(analysis))):
        warning = f"report.pdf: no font there has {lost}; report.html shows them"
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
        if progress:
            progress(warning)
    document = build_document(analysis, gap=gap, changes=changes, progress=progress)
    write_document(document, out, name="report", pdf=pdf)


def _students_text(analysis: Analysis) -> str:
    """Return all that students wrote and the report shows."""
    authors = (part for author in analysis.authors for part in author)
    records = (record.id for record in analysis.records)
    units = (analysis.position_unit, analysis.input_unit)
    notes = analysis.discussion or ""
    return "".join((analysis.title, analysis.section, *authors, *records, *units, notes))
