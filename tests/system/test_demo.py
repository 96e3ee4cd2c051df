"""The demo's second process ends together with the first, and its errors are shown."""

import subprocess
import sys

import psutil
import pytest

from pipeline.cli.demo import found_beside, search_beside
from pipeline.errors import SubmissionError


@pytest.mark.slow
@pytest.mark.sample
def test_an_error_of_the_second_process_is_shown(tmp_path, capsys):
    """If the demo's second process fails, the demo shows its error and its exit status."""
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "submission.toml").write_text("version = 1\n", encoding="utf-8")

    with search_beside(tmp_path) as beside, pytest.raises(SubmissionError, match="system"):
        found_beside(beside, tmp_path)

    assert beside.returncode == 1
    assert "status 1" in capsys.readouterr().err


def test_an_interrupted_demonstration_leaves_no_process_behind(tmp_path):
    """Ctrl-C during the demo ends the second process before it has written anything."""
    with pytest.raises(KeyboardInterrupt), search_beside(tmp_path) as beside:
        raise KeyboardInterrupt
    assert beside.returncode
    assert not (tmp_path / "gap").exists()


def test_a_killed_demonstration_leaves_no_process_behind(tmp_path):
    """If the demo's first process is killed, the second notices it and ends."""
    first = (
        "import sys, time; from pathlib import Path; from pipeline.cli.demo import search_beside\n"
        "with search_beside(Path(sys.argv[1])) as beside:\n"
        "    print(beside.pid, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", first, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None
        second = psutil.Process(int(killed.stdout.readline()))
        killed.kill()
    assert psutil.wait_procs([second], timeout=60)[1] == []
    assert not (tmp_path / "gap").exists()
