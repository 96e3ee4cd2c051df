"""Only one run at a time may write into a folder."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, TimeoutError

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.batch.grade_class import scratch_in
from pipeline.lock import lock_or_refuse
from pipeline.submission import load_submission
from pipeline.submission.edit import Stale, edit_submission, submission_text, text_digest
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import a_submission
from tests.helpers.waiting import PATIENCE

_HOLDER = """
import sys
from pathlib import Path
from pipeline.grading.batch.grade_class import scratch_in
from pipeline.lock import lock_or_refuse
out = Path(sys.argv[1])
with lock_or_refuse(out), scratch_in(out) as scratch:
    (scratch / "copy").touch()
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path):
    """Start another process that holds the folder's lock."""
    command = [sys.executable, "-c", _HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held" + os.linesep.encode()
        yield process
        process.kill()


def test_a_second_run_is_refused_until_the_first_is_dead(other, tmp_path):
    """While one process writes into a folder, a second run is refused and removes nothing.

    Once the first process is dead, the next run gets the lock, and removes the scratch folders of
    both runs.
    """
    refused = pytest.raises(
        ConfigError, match=rf"another cartlab \(process {other.pid}\) is writing"
    )
    with refused, lock_or_refuse(tmp_path):
        pass
    done = cartlab_here("grade", tmp_path / "none", "--rubric", "throne-1dof", "--out", tmp_path)
    assert done.returncode == 2
    assert f"(process {other.pid})" in done.stderr
    assert done.stderr.count("\n") == 1
    assert (tmp_path / f".scratch-{other.pid}" / "copy").is_file()
    other.kill()
    other.wait()
    with lock_or_refuse(tmp_path), scratch_in(tmp_path) as scratch:
        assert [path.name for path in tmp_path.glob(".scratch*")] == [scratch.name]
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.parametrize("released", [False, True])
def test_a_new_folder_that_stays_empty_is_removed(tmp_path, released):
    """The folder is removed also on Windows, where a lock that is released removes its file."""
    new, old = tmp_path / "new", tmp_path / "old"
    old.mkdir()
    for folder in (new, old):
        with lock_or_refuse(folder):
            if released:
                (folder / ".lock").unlink()
    assert (new.exists(), old.exists()) == (False, True)
    with lock_or_refuse(new):
        (new / "report.html").touch()
    assert (new / "report.html").is_file()


_EDITOR = """
import sys
from pathlib import Path
from pipeline.submission.edit import edit_submission
def change(document):
    print("changing", flush=True)
    sys.stdin.read()
    document["title"] = "other"
edit_submission(Path(sys.argv[1]), change)
"""


def test_an_edit_waits_for_that_of_another_process(tmp_path):
    """While another process changes `submission.toml`, an edit waits; then it is outdated."""
    folder = a_submission(tmp_path / "team")
    seen = text_digest(submission_text(folder))
    command = [sys.executable, "-c", _EDITOR, str(folder)]
    with (
        ThreadPoolExecutor(1) as pool,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other,
    ):
        assert other.stdout is not None
        assert other.stdout.readline().strip() == b"changing"
        mine = pool.submit(
            edit_submission, folder, lambda document: document.update(title="mine"), version=seen
        )
        with pytest.raises(TimeoutError):
            mine.result(timeout=0.5)
        other.communicate(timeout=PATIENCE)
        with pytest.raises(Stale):
            mine.result(timeout=PATIENCE)
    assert load_submission(folder).title == "other"


def test_a_foreign_file_with_the_locks_name_is_refused(tmp_path):
    """If a file has the lock's name but is not a lock, the run stops with a message."""
    (tmp_path / ".lock").write_bytes(b"something else" * 100)
    with pytest.raises(ConfigError, match="not a lock"), lock_or_refuse(tmp_path):
        pass


def test_a_new_folder_is_removed_if_the_run_fails(tmp_path):
    """If a run fails at once, a folder made for it is removed.

    A folder that existed before the run stays.
    """
    for out in (tmp_path / "new" / "out", tmp_path):
        with pytest.raises(ZeroDivisionError), lock_or_refuse(out), scratch_in(out):
            raise ZeroDivisionError
    assert list((tmp_path / "new").iterdir()) == []
