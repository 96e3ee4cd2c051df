"""Write the report of a submission into a folder, for `cartlab report` and for the desk."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.json_files import json_text
from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.draft.changes import DraftChanges
from pipeline.report.draft.content import build_document
from pipeline.report.gap.beside import with_gap
from pipeline.report.plots import NAME as PLOTS
from pipeline.report.render.pdf import missing_characters
from pipeline.report.render.write import write_document
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.words.progress import Progress, silent
from pipeline.workflow import analyse

if TYPE_CHECKING:
    from pipeline.gap.types import Gap


@dataclass(frozen=True, kw_only=True)
class Files:
    """Which files are written in addition to `report.html` and `figures/`.

    Attributes
    ----------
    tables : write `tables/*.csv` and `results.mat`.
    plots : write the page with plots of all recordings, and link it in the report.
    """

    pdf: bool = True
    tables: bool = False
    plots: bool = False


def make_report(
    submission: Submission,
    out: Path,
    *,
    compared: Callable[[Analysis], DraftChanges | None],
    files: Files = Files(),
    progress: Progress,
) -> tuple[Analysis, DraftChanges | None]:
    """Analyse a submission and write its report; return the analysis and the changes.

    Parameters
    ----------
    compared : function that returns the differences from an earlier draft; called before
        `results.json` is overwritten.
    """
    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    changes = compared(analysis)
    out.mkdir(parents=True, exist_ok=True)
    tables = own_folder(out, "tables")
    render_report(analysis, out, gap=gap, changes=changes, files=files, progress=progress)
    write_file(out / "results.json", json_text(analysis))
    clear_files(out, "results.mat")  # left by an earlier report
    clear_files(tables, "*.csv")
    if files.tables:
        from pipeline.exchange.saved import save_tables  # imported late, because it loads pandas

        save_tables(analysis, out)
    return analysis, changes


def render_report(
    analysis: Analysis,
    out: Path,
    *,
    gap: "Gap | None" = None,
    changes: DraftChanges | None = None,
    files: Files = Files(),
    progress: Progress = silent,
) -> None:
    """Write `report.html`, `figures/*.svg` and the other requested files into the folder `out`.

    The same analysis gives the same bytes. If the PDF's fonts lack some characters, the report and
    `progress` name them. `progress` also receives the name of each section.
    """
    if files.pdf and (lost := missing_characters(_students_text(analysis))):
        warning = f"report.pdf: its fonts lack {lost}; report.html shows them"
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
        progress(warning)
    document = build_document(analysis, gap=gap, changes=changes, progress=progress)
    plots = ""
    if files.plots:
        # Imported late, because it loads the catalogue of effects.
        from pipeline.report.plots.page import make_page

        document = replace(document, plots=PLOTS)
        plots = make_page(analysis, gap=gap, report=True, progress=progress)
    write_document(document, out, name="report", pdf=files.pdf)
    clear_files(out, PLOTS)  # left by an earlier report
    if plots:
        write_file(out / PLOTS, plots)


def _students_text(analysis: Analysis) -> str:
    """Return all text in the report that was written by students."""
    authors = (part for author in analysis.authors for part in author)
    records = (record.id for record in analysis.records)
    units = vars(analysis.bench.units).values()
    notes = analysis.discussion or ""
    return "".join((analysis.title, analysis.section, *authors, *records, *units, notes))
