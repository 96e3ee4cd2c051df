"""Virtual benches announce themselves to the desks of the same user."""

import json
import os
import sys

import pytest

from pipeline.simulated.links import RunningBench, announced, running_benches


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Keep the benches of these tests apart from those of other tests."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def test_a_bench_is_listed_while_it_runs():
    """A virtual bench is listed while it runs, and neither before nor after."""
    bench = RunningBench(name="throne-1dof", address="socket://127.0.0.1:7")
    assert running_benches() == []
    with announced(bench):
        assert running_benches() == [bench]
    assert running_benches() == []


def test_a_bench_that_was_killed_is_not_listed(own_folder):
    """A killed bench is not listed, even if another process has its number; its file is removed."""
    bench = RunningBench(name="b", address="socket://127.0.0.1:8")
    with announced(bench):
        (folder,) = own_folder.iterdir()
        for pid in (os.getppid(), 2**22 + 1):
            told = {"name": "old", "address": "socket://127.0.0.1:9", "began": 1.0}
            (folder / f"{pid}.json").write_text(json.dumps(told), encoding="utf-8")
        (folder / "1.json").write_text("[1", encoding="utf-8")
        assert running_benches() == [bench]
    with announced(bench):
        assert len(list(folder.iterdir())) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
def test_a_folder_that_others_can_write_to_is_ignored(own_folder):
    """Benches announced in a folder that others can write to, or in a link, are not listed."""
    bench = RunningBench(name="b", address="socket://127.0.0.1:8")
    with announced(bench):
        (folder,) = own_folder.iterdir()
        folder.chmod(0o777)
        assert running_benches() == []
        folder.chmod(0o700)
        assert running_benches() == [bench]
        moved = folder.rename(own_folder / "moved")
        folder.symlink_to(moved)
        assert running_benches() == []
