"""Long work runs in separate processes, so that nobody waits for another person's work."""

import re
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import psutil
import pytest

from pipeline.desk.app import AT_ONCE, DeskServer
from pipeline.desk.jobs import _SHORT_WORKERS, _WAITING, Busy, Jobs, WorkerPool
from pipeline.processes import Failed, LineProcess
from tests.helpers.desks import Visitor, a_submission, at_desk, some_files, wrongs
from tests.helpers.waiting import PATIENCE, until

HERE = "/student/0/"


@pytest.fixture
def jobs():
    """Return the long tasks of a desk; after the test they are ended."""
    jobs = Jobs()
    yield jobs
    jobs.close()


@pytest.fixture
def workers() -> Iterator[WorkerPool]:
    """Return the worker processes for short tasks."""
    workers = WorkerPool()
    yield workers
    workers.close()


def test_a_slow_folder_delays_no_other_folder(tmp_path, workers):
    """A slow task in one folder delays no other folder, however many requests wait for the task."""
    slow = a_submission(tmp_path / "slow")

    def ask(task: str) -> threading.Thread:
        def run() -> None:
            with suppress(Failed):
                workers.do(task, folder=str(slow))

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    threads = [ask("make_report")]
    until(lambda: workers._free.qsize() < _SHORT_WORKERS)
    assert workers.do("list_files", folder=str(tmp_path)) == []
    threads += [ask("list_files") for _ in range(_WAITING - 1)]
    until(lambda: workers._folders[str(slow)][0]._value == 0)  # type: ignore[attr-defined]
    with pytest.raises(Busy):
        workers.do("list_files", folder=str(slow))
    assert threads[0].is_alive()
    workers.close()
    for thread in threads:
        thread.join()


def test_a_job_that_fails_is_over_and_says_why(tmp_path, jobs, monkeypatch):
    """A job fails if its task fails, its process cannot be started, or the desk itself fails.

    The message of a failed task ends with the last lines of its process.
    """
    given = {"title": "The report", "place": tmp_path}
    job = jobs.start("nonsense", **given)
    until(lambda: job.over)
    assert (job.state, "KeyError: 'nonsense'" in job.message) == ("failed", True)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", str(tmp_path / "nothing"))
        job = jobs.start("make_report", folder=str(tmp_path), **given)
        until(lambda: job.over)
        assert (job.state, "be started" in job.message) == ("failed", True)

    def no_more(module: str) -> LineProcess:
        raise MemoryError("no more")

    raised = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    monkeypatch.setattr("pipeline.processes.LineProcess", no_more)
    job = jobs.start("make_report", folder=str(tmp_path), **given)
    until(lambda: job.over and raised)
    assert (job.state, "MemoryError" in job.message) == ("failed", True)


@pytest.mark.usefixtures("work_here")
def test_a_stop_is_answered_while_all_turns_are_taken(tmp_path):
    """Even if all turns of a person are taken, a request to stop the bench is answered at once."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        visitor, workers = Visitor.of(server.url), server._desk.workers
        processes = [workers._free.get() for _ in range(_SHORT_WORKERS)]
        path = "/exercises/picture.svg?preset=throne-2dof&hide=nothing"
        threads = [threading.Thread(target=visitor.get, args=(path,)) for _ in range(20)]
        for thread in threads:
            thread.start()
        try:
            until(lambda: sum("AnyIO worker" in t.name for t in threading.enumerate()) >= AT_ONCE)
            assert visitor.post("/student/0/stop").status == 303
        finally:
            for process in processes:
                workers._free.put(process)
        for thread in threads:
            thread.join()


def test_a_folder_has_one_task_at_a_time(tmp_path, jobs):
    """In each folder only one task runs at a time, and any other task is refused.

    A second request for the running task gives the same job.
    """
    given = {"place": tmp_path, "folder": str(a_submission(tmp_path / "team"))}
    job = jobs.start("make_report", title="The report", **given)
    assert jobs.start("make_report", title="The report", **given) is job
    with pytest.raises(Busy, match="The report"):
        jobs.start("make_solution", title="The solution", **given)
    job.stop.set()
    until(lambda: job.over)
    assert jobs.start("make_solution", title="The solution", **given) is not job


@pytest.mark.slow
@pytest.mark.sample
def test_a_job_survives_a_reload_and_can_be_stopped(tmp_path):
    """Every later page shows a running job and its stage.

    A job that is stopped or killed leaves no half-written file and can be started again.
    """
    folder = a_submission(tmp_path / "team")
    with at_desk(folder) as visitor:
        visitor.get(HERE)
        before = {p.pid for p in psutil.Process().children()}

        def workers() -> list[psutil.Process]:
            return [p for p in psutil.Process().children() if p.pid not in before]

        assert visitor.post(HERE + "make-report").status == 303
        assert visitor.post(HERE + "make-report").status == 303  # this is the same job
        assert "data-events" in visitor.get(HERE).text
        until(workers)
        assert visitor.post(HERE + "stop").status == 303
        until(lambda: "stopped" in " ".join(wrongs(visitor.get(HERE).text)))
        news = visitor.get(HERE + "events")
        assert news.headers["content-type"].startswith("text/event-stream")
        assert news.text.startswith("event: end\n")

        visitor.post(HERE + "make-report")
        until(workers)
        until(lambda: "starting" not in visitor.get(HERE).text)  # until it has begun
        workers()[0].kill()
        until(lambda: "the process ended" in " ".join(wrongs(visitor.get(HERE).text)))
        assert not (folder / "report" / "report.html").exists()

        assert visitor.post(HERE + "make-report").status == 303
        stages = re.findall(r"event: stage\ndata: (.*)", visitor.get(HERE + "events").text)
        assert len(set(stages)) > 3
        page = visitor.get(HERE).text
        assert "Read the report" in page
        assert wrongs(page) == []


@pytest.mark.slow
@pytest.mark.sample
def test_a_file_that_ends_the_process_fails_only_its_row(tmp_path):
    """If a file ends the process that reads it, only the row of this file fails.

    The other files are shown, and the next task gets a new process.
    """
    with at_desk(tmp_path) as visitor:
        visitor.upload(HERE + "files", some_files(most=2))
        before = {p: p.memory_info().rss for p in psutil.Process().children()}
        (tmp_path / "data" / "large.csv").write_bytes(b"time,x1\n" + b"0.001,0.25\n" * 4_000_000)
        with ThreadPoolExecutor(1) as pool:
            page = pool.submit(visitor.get, HERE)
            reading: list[psutil.Process] = []

            def grown() -> bool:
                reading.extend(
                    p for p, was in before.items() if p.memory_info().rss > was + 40_000_000
                )
                return bool(reading)

            until(grown)
            reading[0].kill()
            text = page.result().text
        names = re.findall(r'<tr [^>]*id="file-.*>\n<th scope="row">(.*?)<', text)
        rows = dict(zip(names, re.split(r'<tr [^>]*id="file-', text)[1:], strict=True))
        assert {name for name, row in rows.items() if "the process ended" in row} == {"large.csv"}
        assert len(rows) == 3
        (tmp_path / "data" / "large.csv").unlink()
        assert "the process ended" not in visitor.get(HERE).text


def test_a_failed_task_does_not_end_the_process(tmp_path, workers):
    """If a task fails, the error's kind is named, and the same process does the next task.

    If the desk is killed, the process ends by itself.
    """
    with pytest.raises(Failed, match="TypeError"):
        workers.do("propose_recordings", folder=str(tmp_path), stock=True, nonsense=1)
    worker = workers._free.get()
    process = worker._process
    assert process is not None
    assert "Traceback" in process.stderr_end()
    workers._free.put(worker)
    assert workers.do("list_files", folder=str(tmp_path)) == []
    assert process.runs
    (child,) = [p for p in psutil.Process().children() if p.pid == process._process.pid]
    assert process._process.stdin is not None
    process._process.stdin.close()
    until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.slow
@pytest.mark.sample
def test_a_lab_server_has_its_processes_before_students_ask(tmp_path, workers, monkeypatch):
    """A lab server starts all its worker processes before a student asks for anything.

    After its last allowed task, a process is replaced before the next task arrives.
    """
    monkeypatch.setattr("pipeline.processes._TASKS_EACH", 1)
    workers.start()
    for _ in range(2):
        until(lambda: [one.runs for one in list(workers._free.queue)] == [True] * _SHORT_WORKERS)
        assert workers.do("list_files", folder=str(tmp_path)) == []


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("pipeline.desk.tasks", b"no json\n"),
        pytest.param(
            "pipeline.desk.bench.process",
            b'{"folder": ".", "explore": [[], 7]}\n',
            marks=[pytest.mark.slow, pytest.mark.sample],
        ),
    ],
)
def test_an_exception_that_ends_a_process_is_reported(module, line):
    """If an exception ends a process, the exception is reported, even while a thread waits."""
    process = LineProcess(module)
    try:
        process.send(line)
        while process.line(timeout=PATIENCE):
            pass
        said = process.exit_message()
    finally:
        process.close()
    assert re.search(r"status 1\) \S*Error", said), said
