"""A batch is graded on a real Dask cluster on this machine, with one worker killed."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.batch.cluster import run_on
from pipeline.grading.batch.runner import grade_batch, run_here
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import HandIn, Setup
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.rubric_file import load_rubric
from tests.helpers.grading_students import write_team

RUBRIC = load_rubric(Path("throne-1dof"))


def _dask(*arguments):
    """Start one process of a cluster, without a dashboard and without a supervisor."""
    return subprocess.Popen(
        [sys.executable, "-m", *map(str, arguments), "--no-dashboard"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "60s"},
    )


@pytest.fixture
def cluster(tmp_path):
    """Start a scheduler and two workers; yield the address and the workers' processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    scheduler = _dask("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port)
    options = ("--nthreads", 1, "--no-nanny", "--local-directory")
    workers = [
        _dask("distributed.cli.dask_worker", address, *options, tmp_path / str(i)) for i in range(2)
    ]
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


def grade(folder, out, execute, progress=lambda *_: None):
    (out / "scratch").mkdir(parents=True)
    with Gradebook(out, create=True) as book:
        batch = grade_batch(
            find_hand_ins([folder], scratch=out / "scratch"),
            setup=Setup(rubric=RUBRIC, scratch=out / "scratch"),
            book=book,
            execute=execute,
            progress=progress,
        )
        return batch, [book.known(key) for key in batch.keys]


@pytest.mark.slow
@pytest.mark.sample
def test_a_cluster_gives_the_same_rows_even_if_a_worker_dies(cluster, tmp_path):
    """A cluster gives the same rows as this machine, even if one of two workers is killed."""
    address, workers = cluster
    for number in range(5):
        write_team(tmp_path / "class" / f"team-{number}", number)
    (tmp_path / "class" / "team-9").mkdir()
    seen = []

    def progress(done, total, last):
        seen.append(done)
        if done == 2 and workers[0].poll() is None:
            workers[0].kill()

    batch, rows = grade(tmp_path / "class", tmp_path / "there", run_on(address), progress)
    assert workers[0].wait() != 0
    assert seen[-1] == 6
    here, expected = grade(tmp_path / "class", tmp_path / "here", run_here(jobs=1))
    assert rows == expected
    assert batch == here


def test_an_address_that_is_not_a_schedulers_is_refused():
    """Only a scheduler's address is accepted, and on another machine only with encryption."""
    for address, wanted in (
        ("http://localhost:8786", "tcp://"),
        ("tcp://192.0.2.1:8786", "tls://"),
        ("tls://192.0.2.1:8786", r"distributed\.comm\.tls"),
    ):
        with pytest.raises(ConfigError, match=wanted):
            run_on(address)


def test_an_address_without_a_scheduler_is_an_error(monkeypatch):
    """If no scheduler listens at the address, the batch stops with an error that says so."""
    monkeypatch.setattr("pipeline.grading.batch.cluster._CONNECT_LIMIT", 1)
    setup = Setup(rubric=RUBRIC, scratch=Path())
    with socket.socket() as bound:  # a port on which nothing listens
        bound.bind(("127.0.0.1", 0))
        execute = run_on(f"tcp://127.0.0.1:{bound.getsockname()[1]}")
        with pytest.raises(ConfigError, match="no scheduler"):
            list(execute([HandIn(id="t", key="k", sources=())], setup))
