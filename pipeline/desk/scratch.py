"""Scratch folders of the desk; the next start removes those of a desk that was killed."""

import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

# The name contains the computer's name, because a process number of another container has no
# meaning here.
_OWN = f"cartlab-{re.sub('[^A-Za-z0-9]+', '', platform.node())}"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for uploads and for files to download; remove it at the end."""
    with tempfile.TemporaryDirectory(prefix=f"{_OWN}-{os.getpid()}-") as folder:
        yield Path(folder)


def clear_scratch() -> None:
    """Remove the scratch folders of processes that have ended."""
    for left in Path(tempfile.gettempdir()).glob(f"{_OWN}-*"):
        found = re.fullmatch(_OWN + r"-(\d{1,9})-\w+", left.name)
        if found and not psutil.pid_exists(int(found[1])) and not left.is_symlink():
            # Folders of another user cannot be removed; they stay.
            shutil.rmtree(left, ignore_errors=True)
