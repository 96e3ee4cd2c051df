"""Work in processes of its own: nobody waits for another's, and what became of it is said."""

import sys
import threading
from contextlib import suppress

import pytest

from pipeline.desk.app import DeskServer
from pipeline.desk.jobs import _HANDS, _WAITING, Busy, Failed, Hand, Jobs
from tests.helpers.desks import Visitor, a_submission
from tests.helpers.waiting import until


@pytest.fixture
def jobs():
    """The long work of a desk, which ends."""
    jobs = Jobs()
    yield jobs
    jobs.close()


def test_a_slow_folder_is_waited_for_by_who_looks_at_it_only(tmp_path):
    """Another's task is done meanwhile; of those that wait for the folder, not all threads do."""
    slow, hand = a_submission(tmp_path / "slow"), Hand()

    def ask(task: str) -> threading.Thread:
        def run() -> None:
            with suppress(Failed):
                hand.do(task, folder=str(slow))

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    threads = [ask("report")]
    until(lambda: hand._free.qsize() < _HANDS)
    assert hand.do("files", folder=str(tmp_path)) == []
    threads += [ask("files") for _ in range(_WAITING - 1)]
    until(lambda: hand._folders[str(slow)][0]._value == 0)  # type: ignore[attr-defined]
    with pytest.raises(Busy):
        hand.do("files", folder=str(slow))
    assert threads[0].is_alive()
    hand.close()
    for thread in threads:
        thread.join()


def test_a_stop_waits_for_no_thread(tmp_path):
    """Where all that answer are busy, a page waits, and a Stop does not."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        visitor, hand = Visitor.of(server.url), server._desk.hand
        processes = [hand._free.get() for _ in range(_HANDS)]
        path = "/exercises/picture.svg?preset=throne-2dof&hide=nothing"
        threads = [threading.Thread(target=visitor.get, args=(path,)) for _ in range(45)]
        for thread in threads:
            thread.start()
        try:
            until(lambda: sum("AnyIO worker" in t.name for t in threading.enumerate()) >= 40)
            assert visitor.post("/student/0/stop").status == 303
        finally:
            for process in processes:
                hand._free.put(process)
        for thread in threads:
            thread.join()


def test_a_process_that_does_not_start_ends_its_job(tmp_path, jobs, monkeypatch):
    """The desk says so, and does not wait for it when it is closed."""
    monkeypatch.setattr(sys, "executable", str(tmp_path / "nothing"))
    job = jobs.start("report", title="The report", place=tmp_path, folder=str(tmp_path))
    until(lambda: job.over)
    assert (job.state, "no process could be started" in job.said) == ("failed", True)


def test_a_fault_of_our_own_is_told(tmp_path, jobs):
    """The end of what the process said, by which it can be reported."""
    job = jobs.start("nonsense", title="Nonsense", place=tmp_path)
    until(lambda: job.over)
    assert job.state == "failed"
    assert "KeyError: 'nonsense'" in job.said


def test_one_thing_at_a_time_in_a_folder(tmp_path, jobs):
    """The same again is the same job; another is refused with what is under way."""
    given = {"place": tmp_path, "folder": str(a_submission(tmp_path / "team"))}
    job = jobs.start("report", title="The report", **given)
    assert jobs.start("report", title="The report", **given) is job
    with pytest.raises(Busy, match="The report is under way"):
        jobs.start("solution", title="The solution", **given)
    job.stop.set()
    until(lambda: job.over)
    assert jobs.start("solution", title="The solution", **given) is not job
