"""What the desk's worker does for a class, by name: JSON in, JSON out."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.desk.typed import typed_path
from pipeline.errors import ConfigError

Progress = Callable[[str], None]


def publish(folder: str, *, progress: Progress) -> None:
    """Write the class list of the gradebook in a folder."""
    from pipeline.grading.gradebook.book import Gradebook
    from pipeline.grading.publish.outputs import write_outputs
    from pipeline.lock import alone_in

    out = Path(folder)
    progress("pages and feedback")
    with Gradebook(out) as book, alone_in(out):
        write_outputs(book, out)


def regrade(
    folder: str,
    paths: Sequence[str],
    rubric: str,
    lateness: str,
    anonymous: bool,
    *,
    progress: Progress,
) -> str:
    """Grade a class into a folder; an anonymous one says nothing that could name a team."""
    from pipeline.grading.batch.grade_class import grade_class
    from pipeline.grading.batch.runner import Limits

    try:
        done = grade_class(
            [typed_path(path, wanted="name the submissions") for path in paths],
            rubric_file=Path(rubric),
            out=Path(folder),
            jobs=os.cpu_count() or 1,
            cluster=None,
            limits=Limits(),
            figures=True,
            progress=lambda done, total, last: progress(f"{done} of {total}"),
            anonymous=anonymous,
            lateness=Path(lateness) if lateness else None,
        )
    except ConfigError:
        if anonymous:
            raise ConfigError("it could not begin; cartlab grade in a terminal says why") from None
        raise
    return "; ".join([done.counted, *(() if anonymous else done.remarks)])
