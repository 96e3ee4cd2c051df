"""Two threads map work, also from inside such work, and stop at the first error."""

from threading import Event

import pytest

from pipeline.gap.explain import two_workers

LIMIT = 60.0  # s; a thread that waits longer waits for ever


def test_work_may_map_its_own_items():
    """A job that maps gets its own results, at every depth."""
    with two_workers() as mapper:

        def total(depth: int) -> int:
            return sum(mapper(total, [depth - 1] * 3)) if depth else 1

        assert mapper(total, [4, 3, 2]) == [81, 27, 9]


def test_the_first_error_ends_a_map():
    """An error in a job, or in the map of a job, reaches the caller; later jobs do not begin."""
    begun = []

    def fail(at: int) -> None:
        begun.append(at)
        raise ValueError("no")

    with two_workers() as mapper:
        with pytest.raises(ValueError, match="no"):
            mapper(fail, range(100))
        assert len(begun) < 100
        with pytest.raises(ValueError, match="no"):
            mapper(lambda at: mapper(fail, range(at)), [1])
        assert mapper(abs, [-1]) == [1]


def test_the_helper_stops_when_the_work_is_given_up():
    """If the caller's own job fails, the helper's long job ends at its next map."""
    started = Event()

    def work(at: int) -> None:
        if at:
            started.set()
            while True:
                mapper(abs, range(2))
        assert started.wait(LIMIT)
        raise KeyboardInterrupt

    with two_workers() as mapper, pytest.raises(KeyboardInterrupt):
        mapper(work, range(2))
