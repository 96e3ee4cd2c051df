"""The scratch folder of a grading run."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.output import own_folder

_SCRATCH = re.compile(r"\.scratch(-\d+)?")


@contextmanager
def scratch_in(out: Path) -> Iterator[Path]:
    """Make a scratch folder that is removed at the end; only whoever is alone there may ask.

    What is left of runs that were stopped is removed first.
    """
    for left in sorted(out.iterdir()):
        if _SCRATCH.fullmatch(left.name) and left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
    scratch = own_folder(out, f".scratch-{os.getpid()}")
    scratch.mkdir(exist_ok=True)
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
