"""Write a document's files into its folder."""

from collections.abc import Mapping
from pathlib import Path

from pipeline.output import clear_files, own_folder, write_file

Made = Mapping[str, str | bytes]  # contents of files by their paths in the folder
FIGURES = "figures"  # folder of the figures


def write_files(made: Made, out: Path, *, name: str) -> None:
    """Write the files of a document in place of those of an earlier one.

    All files are made before the first one is written, so an interrupted run leaves the earlier
    document complete.

    Parameters
    ----------
    name : name of the page and the PDF, without ending.
    """
    figures = own_folder(out, FIGURES)
    figures.mkdir(parents=True, exist_ok=True)
    clear_files(figures, "*.svg")
    clear_files(out, f"{name}.pdf")
    for file, content in made.items():
        write_file(out / file, content)
