"""Find the recordings of a graded team on this computer, because a gradebook stores no folder.

The notes and the PDF files of the team are read from the same folder.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from markupsafe import Markup

from pipeline.desk.gradebooks import ClassView
from pipeline.desk.grades.grading_form import last_run
from pipeline.desk.last_report import PLOTS, PLOTS_OF
from pipeline.desk.page_request import PageRequest
from pipeline.grading.gradebook.entry import Entry
from pipeline.grading.intake.files import digest
from pipeline.output import LOCK
from pipeline.submission.load import NAME, file_problem

# Files that making the plots adds to a folder.
_ADDED = (PLOTS, PLOTS_OF, f"{Path(PLOTS).parent.name}/{LOCK}")
_MOST_PAPERS = 20  # PDF files listed


def show_notes(ask: PageRequest, folder: Path) -> Markup:
    """Return a team's notes as HTML. A worker makes it, because the desk parses no such file."""
    return Markup(ask.desk.workers.do("render_notes", folder=str(folder)))


def list_papers(folder: Path) -> list[str]:
    """Return the PDF files in a submission's folder, by their paths in it."""
    files = (file for file in folder.rglob("*") if file.suffix.lower() == ".pdf")
    names = sorted(file.relative_to(folder).as_posix() for file in files)
    return list(islice((n for n in names if file_problem(folder, n) is None), _MOST_PAPERS))


def find_recordings(ask: PageRequest, shown: ClassView, entry: Entry) -> Path | None:
    """Return the folder that was graded; None if it is not found or not allowed.

    The folder's files must be those that were graded, because a later version would show other
    recordings. Plots that were added since do not matter.
    """
    if not ask.user.owns or shown.names is not None:
        return None
    graded = entry.key.rpartition("-")[2]
    for folder in dict.fromkeys(_list_candidates(ask, entry.submission)):
        if (folder / NAME).is_file():
            now = (digest([folder], without=added) for added in ((), _ADDED))
            if graded in now:
                return folder
    return None


def _list_candidates(ask: PageRequest, name: str) -> Iterator[Path]:
    """Yield folders that may be the submission: open ones, graded ones, or near the gradebook."""
    place = ask.place_or_404()
    yield from (folder for folder in ask.user.folders if folder.name == name)
    for path in getattr(last_run(ask.user, place), "paths", ()):
        yield from (Path(path), Path(path) / name)
    if isinstance(place, Path):
        yield place.parent / name
        yield from (beside / name for beside in sorted(place.parent.iterdir()))
