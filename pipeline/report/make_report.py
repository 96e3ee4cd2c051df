"""Write the report of a submission into a folder, for `cartlab report` and for the desk."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.json_files import json_text
from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.files import Made, write_files
from pipeline.report.gap_files import with_gap
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.words.progress import Progress

if TYPE_CHECKING:
    from pipeline.report.changes import DraftChanges

NAME = "report"  # of the page and the PDF
COMPARE = "compare.html"  # the page with interactive plots of every recording and its models


@dataclass(frozen=True, kw_only=True)
class Files:
    """Which files are made in addition to `report.html` and `figures/`.

    Attributes
    ----------
    tables : write `tables/*.csv` and `results.mat`.
    plots : make the page with plots of all recordings, and link it in the report.
    """

    pdf: bool = True
    tables: bool = False
    plots: bool = False


PAGE_AND_PDF = Files()


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A report that was made.

    Attributes
    ----------
    files : contents of the pages and figures.
    summary : what was found, for a terminal.
    remarks : lines on the changes, and on formulas that are not typeset.
    findings : what the report assumed, asked and found wrong, as JSON for the desk.
    """

    files: Made
    summary: str
    remarks: tuple[str, ...]
    findings: Mapping[str, Any]


def make_report(
    submission: Submission,
    out: Path,
    *,
    compared: "Callable[[Analysis], DraftChanges | None]",
    make: Callable[..., Draft],
    files: Files = PAGE_AND_PDF,
    progress: Progress,
) -> tuple[Analysis, Draft]:
    """Analyse a submission and write its report; return the analysis and the report.

    Parameters
    ----------
    compared : function that returns the differences from an earlier draft; called before
        `results.json` is overwritten.
    make : `make_draft`, or a function that calls it in another process.
    """
    from pipeline.workflow import analyse  # late: the process that draws does not need it

    analysis, gap = with_gap(analyse(submission, progress=progress), submission.folder)
    changes = compared(analysis)
    tables = own_folder(out, "tables")
    draft = make(analysis, gap=gap, changes=changes, files=files, progress=progress)
    write_draft(draft.files, out)
    write_file(out / "results.json", json_text(analysis))
    clear_files(out, "results.mat")  # left by an earlier report
    clear_files(tables, "*.csv")
    if files.tables:
        from pipeline.report.tables import (
            save_tables,
        )  # imported late, because it loads pandas

        save_tables(analysis, out)
    return analysis, draft


def write_draft(made: Made, out: Path) -> None:
    """Write the files of a report in place of those of an earlier one."""
    if COMPARE not in made:
        clear_files(out, COMPARE)
    write_files(made, out, name=NAME)
