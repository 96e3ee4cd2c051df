"""Map work over runs with two threads."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from pipeline.gap.fit.levenberg_marquardt import Mapper

_WORKERS = 2


@contextmanager
def two_workers() -> Iterator[Mapper]:
    """Give a function that maps like the built-in `map`, with two threads.

    The threads take items from a common list, since a task of the pool for each short run takes
    noticeable time.
    """
    with ThreadPoolExecutor(max_workers=_WORKERS) as pool:

        def mapper(work: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
            jobs = list(zip(*items, strict=False))
            done: list[Any] = [None] * len(jobs)
            open_jobs = iter(range(len(jobs)))

            def go(_: int) -> None:
                for at in open_jobs:
                    done[at] = work(*jobs[at])

            list(pool.map(go, range(_WORKERS)))
            return done

        yield mapper
