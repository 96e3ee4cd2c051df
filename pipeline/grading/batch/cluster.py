"""Grade hand-ins on a Dask cluster; each task carries the submitted files.

Each Dask worker starts separate grading processes (`runner.Grader`). A submission that crashes or
hangs ends only its grading process, not the Dask worker.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from urllib.parse import urlsplit
from uuid import uuid4

from distributed import Client, Security, WorkerPlugin, as_completed, get_worker
from distributed.worker import Worker as DaskWorker

from pipeline.errors import ConfigError, is_disk_full
from pipeline.grading.batch.runner import Executor, Grader, code_version
from pipeline.grading.gradings import Grading, HandIn, Setup, failed
from pipeline.grading.intake.files import packed, unpacked

_CONNECT_LIMIT = 20  # s
_AHEAD = 2  # tasks under way per thread: enough to keep threads busy, without using much memory
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def run_on(address: str) -> Executor:
    """Return a function that grades hand-ins on a Dask cluster.

    Parameters
    ----------
    address : address of the cluster's scheduler, `tcp://HOST:PORT` or `tls://HOST:PORT`.

    Raises
    ------
    ConfigError : the address is not valid, is a `tcp://` address of another machine (without
        encryption), or needs certificates that are missing. The returned function raises this error
        if no scheduler or worker answers, or if the cluster runs another version of cartlab.
    """
    parts = urlsplit(address)
    if parts.scheme not in ("tcp", "tls") or not parts.hostname:
        raise ConfigError(f"{address}: expected a scheduler's address, tcp://HOST:PORT or tls://…")
    if parts.scheme == "tcp" and parts.hostname not in _LOOPBACK:
        raise ConfigError(
            f"{address}: a scheduler runs any code it receives, so on another machine it needs "
            f"encryption: start it with TLS certificates and use its address tls://…"
        )
    if parts.scheme == "tls" and Security().get_connection_args("client")["ssl_context"] is None:
        raise ConfigError(
            f"{address}: no certificates in Dask's configuration (distributed.comm.tls)"
        )

    def execute(hand_ins: Sequence[HandIn], setup: Setup) -> Iterator[Grading]:
        try:
            client = Client(address, timeout=_CONNECT_LIMIT, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise ConfigError(f"{address}: no scheduler answers ({error})") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_LIMIT)
            except TimeoutError:
                raise ConfigError(f"{address}: the scheduler has no workers") from None
            # Several runs can share a cluster. A unique name keeps their graders and rubrics apart.
            graders = f"cartlab-graders-{uuid4()}"
            client.register_plugin(Graders(setup), name=graders)
            try:
                yield from _grade_all(client, hand_ins, graders=graders, out_of=setup.rubric.out_of)
            finally:
                client.unregister_worker_plugin(graders)

    return execute


class Graders(WorkerPlugin):
    """The grading processes of one Dask worker, started when needed and ended with the worker."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._code = code_version()

    def setup(self, worker: DaskWorker) -> None:
        """Make a folder for submissions; grading processes start later, when hand-ins need them."""
        self._folder = tempfile.TemporaryDirectory(prefix="cartlab-", ignore_cleanup_errors=True)
        self._idle: SimpleQueue[Grader] = SimpleQueue()
        self._all: list[Grader] = []
        self.same_code = self._code == code_version()

    def teardown(self, worker: DaskWorker) -> None:
        """End the grading processes and remove the folder."""
        for process in self._all:
            process.close()
        self._folder.cleanup()

    def grade(self, hand_in: HandIn, archive: bytes) -> Grading:
        """Write the submission to disk and grade it in a separate process."""
        try:
            process = self._idle.get_nowait()
        except Empty:
            process = Grader(replace(self._setup, scratch=Path(self._folder.name)))
            self._all.append(process)
        try:
            with tempfile.TemporaryDirectory(
                dir=self._folder.name, ignore_cleanup_errors=True
            ) as folder:
                unpacked(archive, Path(folder))
                return process.run(replace(hand_in, sources=(Path(folder),)))
        finally:
            self._idle.put(process)


def _grade_on_worker(hand_in: HandIn, archive: bytes, plugin: str) -> Grading:
    """Grade a hand-in on a Dask worker, with the plugin `Graders` of that worker."""
    graders = get_worker().plugins[plugin]
    assert isinstance(graders, Graders)
    if not graders.same_code:
        raise ConfigError("the cluster's workers run another version of cartlab, numpy or scipy")
    return graders.grade(hand_in, archive)


def _grade_all(
    client: Client, hand_ins: Sequence[HandIn], *, graders: str, out_of: float
) -> Iterator[Grading]:
    """Yield each outcome when it is ready.

    If a worker is lost, Dask runs its tasks again on another worker.
    """
    waiting = list(reversed(hand_ins))
    under_way: dict[str, HandIn] = {}
    answers = as_completed(loop=client.loop)
    while waiting or under_way:
        workers = client.scheduler_info(n_workers=-1)["workers"]  # they come and go
        room = max(1, _AHEAD * sum(worker["nthreads"] for worker in workers.values()))
        while waiting and len(under_way) < room:
            hand_in = waiting.pop()
            try:
                archive = packed(hand_in.sources)
            except OSError as error:
                reason = f"cannot be read ({error.strerror or error}); the next run tries again"
                yield failed(hand_in, reason, out_of=out_of, settled=False)
                continue
            key = f"{graders}-{hand_in.key}"
            future = client.submit(_grade_on_worker, hand_in, archive, graders, key=key, pure=False)
            under_way[str(future.key)] = hand_in
            answers.add(future)
        if not under_way:
            continue
        future = next(answers)
        hand_in = under_way.pop(str(future.key))
        if future.status == "finished":
            yield future.result()
        elif isinstance(error := future.exception(), ConfigError):
            raise error
        else:
            reason = f"the cluster could not grade it: {error}"
            outcome = failed(hand_in, reason, out_of=out_of, settled=False)
            yield replace(outcome, is_disk_full=isinstance(error, OSError) and is_disk_full(error))
