"""If a bench's clock, line or motor differs from what it states, the data are still kept."""

import socket
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.bench.experiments import readings_of
from pipeline.bench.raw import read_raw
from pipeline.bench.stamps import fit_stamps
from pipeline.protocol import (
    EXTENSIONS,
    Description,
    Reading,
    Signal,
    Start,
    Wave,
    format_description,
    format_reading,
    target_at,
)
from pipeline.simulated.controller import CommandReader
from pipeline.submission import load_submission
from tests.helpers.acquisitions import Notes, carried_out, causes, sine, write_work

BENCH = Description(
    name="odd", encoders=2, carts=2, commands=EXTENSIONS - {"h"}, input_per_count=0.5 / 4096,
    position_unit="cm", position_per_count=0.002,
)  # fmt: skip
RUN = 4000  # ms
NOTHING = Start(wave=Wave.DELTA, frequency=20.0, amplitude=0)


class OddBench(threading.Thread):
    """A bench on a socket that keeps to the protocol, but changes the lines of a run.

    Parameters
    ----------
    lines : function from a run's correct lines to the lines that are sent.
    late : further lines that arrive just after the first stop.
    """

    def __init__(
        self, lines: Callable[[list[Reading]], Iterator[Reading]], *, late: Sequence[Reading] = ()
    ) -> None:
        super().__init__(daemon=True)
        self._lines = lines
        self._late = late
        self._door = socket.create_server(("127.0.0.1", 0))
        self.address = f"socket://127.0.0.1:{self._door.getsockname()[1]}"
        self.start()

    def run(self) -> None:
        """Serve one host until it hangs up."""
        peer, _ = self._door.accept()
        reader = CommandReader(encoders=2, extensions=BENCH.commands)
        with self._door, peer:
            while heard := peer.recv(4096):
                for command in reader.feed(heard):
                    if command is Signal.QUERY:
                        peer.sendall(format_description(BENCH))
                    elif isinstance(command, Start):
                        peer.sendall(b"".join(map(format_reading, self._lines(_whole(command)))))
                    elif command is Signal.STOP and self._late:
                        time.sleep(0.3)
                        peer.sendall(b"".join(map(format_reading, self._late)))
                        self._late = ()


def _whole(start: Start) -> list[Reading]:
    targets = [target_at(start, 1e-3 * ms) for ms in range(round(1e3 * start.duration))]
    return [Reading(counts=(2 * r, r), target=r, duty=r, ms=ms) for ms, r in enumerate(targets)]


def _with(reading: Reading, **changes: int) -> Reading:
    return Reading(**{**vars(reading), **changes})


@pytest.mark.parametrize(
    ("stamp", "cause", "kept"),
    [
        (lambda ms: min(ms, 500), "clock", 877),  # frozen from 0.5 s on
        (lambda ms: 0, "clock", 501),
        (lambda ms: ms if ms < 500 else ms + 8_640_000_000, "stamps", 500),  # a hundred days ahead
    ],
)
def test_a_clock_that_stops_or_leaps_ends_the_run(tmp_path, stamp, cause, kept):
    """A run whose clock stops or leaps is ended as partial; the lines received so far are saved."""
    work = write_work(tmp_path, [sine("dwell", seconds=RUN / 1e3)])
    odd = OddBench(lambda lines: (_with(r, ms=stamp(r.ms)) for r in lines))
    tracemalloc.start()
    outcomes = carried_out(work, odd.address)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [causes(outcome.partial) for outcome in outcomes] == [[cause]] * 3
    assert load_submission(work).experiments == ()
    rows = (work / "data" / "dwell.partial.txt").read_text(encoding="utf-8").splitlines()[1:]
    assert len(rows) == kept
    assert len(readings_of(read_raw(work / "raw" / "dwell-1.raw"))) == kept
    assert most < 50e6  # bytes


def test_late_lines_of_the_previous_run_do_not_count(tmp_path):
    """Lines of an earlier run that arrive late are not counted in the next run."""
    first = iter([True])

    def reset(lines: list[Reading]) -> Iterator[Reading]:
        is_broken = len(lines) == RUN and next(first, False)
        return (_with(r, ms=r.ms % 600) for r in lines[:700]) if is_broken else iter(lines)

    bench = OddBench(reset, late=[_with(r, ms=r.ms + 50) for r in _whole(NOTHING)])
    work = write_work(tmp_path, [sine("dwell", seconds=RUN / 1e3)])
    broken, again = carried_out(work, bench.address)
    assert causes(broken.partial) == ["restart"]
    assert (again.partial, again.lines, str(again.anomalies)) == ("", RUN, "none")


@pytest.mark.parametrize("lost", [(), (500, 1700, 1701)])
def test_a_clock_slower_than_stated_loses_nothing(tmp_path, lost):
    """A period of 1.3 ms instead of 1 ms is noted once, and only missing lines count as lost."""

    def slow(lines: list[Reading]) -> Iterator[Reading]:
        return (lines[int(1.3 * k)] for k in range(round(len(lines) / 1.3)) if k not in lost)

    work, notes = write_work(tmp_path, [sine("dwell", seconds=RUN / 1e3)]), Notes()
    (outcome,) = carried_out(work, OddBench(slow).address, notes=notes)
    assert outcome.partial == ""
    assert outcome.anomalies.lost == len(lost)
    assert len([r for r in notes.remarks if "1 ms" in r and "1.3 ms" in r]) == 1


def test_a_motor_that_is_driven_the_other_way_is_stopped(tmp_path):
    """If the duty in open loop has the opposite sign of the target, the run is not repeated."""
    reversed_ = OddBench(lambda lines: (_with(r, duty=-r.duty) for r in lines))
    work = write_work(tmp_path, [sine("dwell", seconds=RUN / 1e3)])
    (outcome,) = carried_out(work, reversed_.address)
    assert (causes(outcome.partial), outcome.is_unsafe) == (["duty"], True)
    assert load_submission(work).experiments == ()


@given(
    steps=st.lists(st.sampled_from([0, 0, 1, 1, 1, 2, 3, 7, 1000, 10**9]), max_size=60),
    still=st.sampled_from([0, 1]),
    period=st.sampled_from([0.5, 1.0, 1.0024, 1.3, 5.0, 1e6]),
    stated=st.booleans(),
)
def test_any_stamps_have_a_clock(steps, still, period, stated):
    """Time stamps that never decrease give a positive period and no negative number of losses."""
    stamps = np.cumsum([0, *steps, *[still] * 60])
    fit = fit_stamps(stamps, period=period, stated=stated)
    assert fit.period > 0
    assert fit.missing >= 0


@pytest.mark.parametrize("lost", [(), (40,), (40, 41, 200)])
def test_each_gap_of_a_slow_bench_is_a_lost_line(lost):
    """With a line every 10 ms, `fit_stamps` counts the lines that are lost, and only those."""
    stamps = np.delete(10 * np.arange(400, dtype=np.int64), lost)
    fit = fit_stamps(stamps, period=10.0)
    assert fit.missing == len(lost)
    assert fit.period == pytest.approx(10.0)
