"""Run the command line in a process of its own or, faster, in this process."""

import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from unittest.mock import patch

import pytest

from pipeline.cli import main
from tests.helpers.waiting import PATIENCE

Done = subprocess.CompletedProcess[str]


def cartlab(*arguments: object, cwd: Path | None = None) -> Done:
    """Run a command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *map(str, arguments)],
        capture_output=True,
        text=True,
        encoding="utf-8",
        cwd=cwd,
        timeout=PATIENCE,
        check=False,
    )


def cartlab_here(*arguments: object, cwd: Path | None = None) -> Done:
    """Run a command in this process, which is faster than starting one; exceptions are raised."""
    words = ["cartlab", *map(str, arguments)]
    out, err = StringIO(), StringIO()
    with (
        patch.object(sys, "argv", words),
        chdir(cwd or Path.cwd()),
        redirect_stdout(out),
        redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        main()
    status = end.value.code or 0
    assert isinstance(status, int)
    return Done(words, status, out.getvalue(), err.getvalue())
