"""The time limit of a search; when it is reached, the best answer so far is used."""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from pipeline.gap.fit.levenberg_marquardt import Mapper


class OutOfTime(Exception):
    """The time limit is reached; the caller keeps its best result."""


class Deadline:
    """Maps a function over runs until the time is up; all slow work goes through here.

    `cut` is true if any work was refused. The answer then depends on the speed of the computer.
    """

    def __init__(self, mapper: Mapper, *, seconds: float | None) -> None:
        """Start the clock; `seconds` None means no limit."""
        self.cut = False
        self._mapper = mapper
        self._end = None if seconds is None else time.monotonic() + seconds

    def map(self, work: Callable[[Any], Any], *items: Iterable[Any]) -> Iterator[Any]:
        """Map like the built-in `map`.

        Raises
        ------
        OutOfTime : the time is up, before or between two items.
        """

        def in_time(*item: Any) -> Any:
            if self._end is not None and time.monotonic() > self._end:
                self.cut = True
                raise OutOfTime
            return work(*item)

        return iter(self._mapper(in_time, *items))
