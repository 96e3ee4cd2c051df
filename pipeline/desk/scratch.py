"""Scratch folders of a desk; what one that was killed has left there goes with the next start."""

import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

# A computer's name is in it: of a process in another container, its number says nothing here.
_OWN = f"cartlab-{re.sub('[^A-Za-z0-9]+', '', platform.node())}"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for what is uploaded, or written to be downloaded; it goes at the end."""
    with tempfile.TemporaryDirectory(prefix=f"{_OWN}-{os.getpid()}-") as folder:
        yield Path(folder)


def clear_scratch() -> None:
    """Remove the scratch folders of processes that are gone."""
    for left in Path(tempfile.gettempdir()).glob(f"{_OWN}-*"):
        found = re.fullmatch(_OWN + r"-(\d{1,9})-\w+", left.name)
        if found and not psutil.pid_exists(int(found[1])) and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)  # another user's stays: it cannot be removed
