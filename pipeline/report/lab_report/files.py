"""What a report consists of; these types load no library, unlike the module that makes them."""

from dataclasses import dataclass

from pipeline.report.render.folder import Made

NAME = "report"  # of the page and the PDF


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
    remarks : lines on the changes and on the open questions.
    """

    files: Made
    summary: str
    remarks: tuple[str, ...]
