"""Map work over runs and models with two threads; the work may map too."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import Condition, Thread
from typing import Any

from pipeline.gap.fit.levenberg_marquardt import Mapper


@contextmanager
def two_workers() -> Iterator[Mapper]:
    """Give a function that maps like the built-in `map`, with this thread and a helper.

    The first error ends a map. A thread that waits for the other one takes over some of its work.
    """
    crew = _Crew()
    helper = Thread(target=crew.help, daemon=True)
    helper.start()
    try:
        yield crew.map
    finally:
        crew.close()
        helper.join()


class _Closed(Exception):
    """The work is no longer wanted."""


class _Map:
    """One call of the mapper, with the results so far."""

    def __init__(self, work: Callable[..., Any], jobs: list[tuple[Any, ...]]) -> None:
        self.work, self.jobs = work, jobs
        self.results: list[Any] = [None] * len(jobs)
        self.begun = self.ended = 0
        self.error: BaseException | None = None

    @property
    def is_open(self) -> bool:
        """Whether a thread can begin a job."""
        return self.error is None and self.begun < len(self.jobs)

    @property
    def is_over(self) -> bool:
        """Whether no thread has, or can begin, a job."""
        return self.begun == self.ended and not self.is_open

    def do(self, at: int) -> None:
        """Do one job."""
        try:
            self.results[at] = self.work(*self.jobs[at])
        except BaseException as error:
            self.error = self.error or error


class _Crew:
    """Two threads and their maps; a map that a job opens comes after the job's own map."""

    def __init__(self) -> None:
        self._maps: list[_Map] = []
        self._change = Condition()
        self._closed = False

    def map(self, work: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
        """Map like the built-in `map`."""
        mine = _Map(work, list(zip(*items, strict=False)))
        with self._change:
            if self._closed:
                raise _Closed
            self._maps.append(mine)
            self._change.notify_all()
        try:
            # Work of an older map could last much longer than this one.
            self._work(lambda: mine.is_over, lambda: self._maps[self._maps.index(mine) :])
        finally:
            with self._change:
                self._maps.remove(mine)
        if mine.error:
            raise mine.error
        return mine.results

    def help(self) -> None:
        """Work until the crew is closed; the oldest map comes first, because its jobs are long."""
        self._work(lambda: self._closed, lambda: self._maps)

    def close(self) -> None:
        """Refuse further maps, which ends the helper's work."""
        with self._change:
            self._closed = True
            self._change.notify_all()

    def _work(self, over: Callable[[], bool], maps: Callable[[], list[_Map]]) -> None:
        while True:
            with self._change:
                one = None
                while not over() and (one := _first_open(maps())) is None:
                    self._change.wait()
                if one is None or over():
                    return
                at = one.begun
                one.begun += 1
            one.do(at)
            with self._change:
                one.ended += 1
                # After Ctrl-C nobody wants the other thread's work either.
                self._closed |= isinstance(one.error, KeyboardInterrupt)
                self._change.notify_all()


def _first_open(maps: Iterable[_Map]) -> _Map | None:
    return next((one for one in maps if one.is_open), None)
