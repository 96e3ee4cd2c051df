"""A bench that misbehaves is stopped and not started again, in every phase of a session."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.bench.acquire import explore_bench
from pipeline.bench.run import LineWatch
from pipeline.errors import HardwareError
from pipeline.experiments.information import ErrorGoal
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.protocol import EXTENSIONS, Reading
from pipeline.report.exploration import write_diary
from pipeline.submission import load_submission
from tests.helpers.acquisitions import (
    Notes,
    carried_out,
    causes,
    decay,
    ordered,
    sine,
    write_work,
)
from tests.helpers.runaway import BENCH, PER_COUNT, RunawayBench
from tests.helpers.waiting import until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")

AT_ONCE = 20  # ms on the bench's clock, as docs/bench.md promises
FULL = 4096
FAR = round(11.0 / PER_COUNT)  # counts, for a limit of 2.5 cm
BY_HANDS = EXTENSIONS - {"h"}  # a person moves the carts, since `h` is unknown


# ------------------------------------------------------------- when the bench misbehaves


def before_start(bench: RunawayBench) -> bool:
    """Return whether the bench has answered but has not yet started a run."""
    return bench.resets > 0 and not bench.starts


def resting(bench: RunawayBench) -> bool:
    """Return whether the host is waiting for the carts to come to rest."""
    return bench.run_on is not None and bench.run_on.amplitude == 0 and bench.run_on.frequency < 2


def resting_again(bench: RunawayBench) -> bool:
    """Return whether the host is waiting for rest before the second recording."""
    return resting(bench) and len(bench.starts) > 2


def running(bench: RunawayBench) -> bool:
    """Return whether the motor should be moving the carts."""
    return bench.run_on is not None and bench.run_on.amplitude != 0


def between(bench: RunawayBench) -> bool:
    """Return whether the first recording is over and the next rest has not started."""
    return bench.is_stopped and len(bench.starts) == 2


def tried(bench: RunawayBench) -> bool:
    """Return whether the empty run that shows whether this is a stock bench is in progress."""
    return bench.run_on is not None and len(bench.starts) == 1


def in_the_decay(bench: RunawayBench) -> bool:
    """Return whether a decay by hand is in progress, in which the motor has no duty."""
    return bench.run_on is not None and len(bench.starts) == 2


def ended(bench: RunawayBench) -> bool:
    """Return whether a stock bench has finished its first recording."""
    return bench.run_on is None and len(bench.starts) == 3


def at_the_end(bench: RunawayBench) -> bool:
    """Return whether the last recording is over."""
    return bench.is_stopped and len(bench.starts) == 4


# ------------------------------------------------------------------ what the host then does


def plan() -> list[Recording]:
    """Return two dwells, each after a rest."""
    return [sine(name, seconds=0.5, settle=0.6) for name in ("first", "second")]


def by_hand() -> Recording:
    """Return a decay that begins with a release by hand."""
    return decay("decay", carts=(1, 2), seconds=0.5, settle=0.6)


def too_far(folder: Path) -> Path:
    """Write a submission whose first run passes its travel limit and whose second does not."""
    first, second = plan()  # the carts move by at most 82 counts
    near = PlanLimits(input=0.5, travel=70 * PER_COUNT)
    return write_work(folder, [first.model_copy(update={"amplitude": 0.03}), second], limits=near)


def assert_over(bench: RunawayBench) -> None:
    """Check that the bench misbehaved, was stopped at once, and was not started again."""
    assert bench.offence is not None
    assert bench.stopped_at is not None
    assert bench.stopped_at - bench.offence <= AT_ONCE
    assert bench.started_after == []


def session(
    work: Path, bench: RunawayBench, *, notes: Notes | None = None, only: Sequence[str] = ()
) -> tuple[list[str], str]:
    """Acquire; return the reasons of the incomplete runs, and the error that ended the session."""
    notes, error = notes or Notes(), ""
    try:
        carried_out(work, bench.address, *(only or ["first", "second"]), notes=notes)
    except HardwareError as raised:
        error = str(raised)
    return [outcome.partial for outcome in notes.outcomes if outcome.partial], error


ON, LITTLE, AWAY = {"duty": FULL}, {"duty": 3}, {"out": FAR}
PULLED = {"only": ["decay", "first"]}


@pytest.mark.parametrize(
    ("wrong", "how", "commands", "cause", "recorded"),
    [
        *((wrong, ON, commands, "idle motor", recorded)
          for wrong, recorded in ((before_start, 0), (between, 1), (at_the_end, 2))
          for commands in (EXTENSIONS, BY_HANDS)),
        *((wrong, how, EXTENSIONS, "duty", recorded)
          for wrong, recorded in ((resting, 0), (resting_again, 1), (running, 0))
          for how in (ON, LITTLE)),
        (resting_again, AWAY, EXTENSIONS, "travel", 1),
        (lambda bench: bench.is_pulled, ON | PULLED, EXTENSIONS, "idle motor", 0),
        (in_the_decay, ON | PULLED, BY_HANDS, "duty", 0),
    ],
)  # fmt: skip
def test_a_bench_that_misbehaves_ends_the_session(tmp_path, wrong, how, commands, cause, recorded):
    """A motor with another duty than ordered, or a cart too far out, ends the session at once.

    This holds in each phase, whether the duty differs by a lot or a little. The runs before it
    stay.
    """
    work, only = write_work(tmp_path, [by_hand(), *plan()]), how.get("only", ())
    odd = {key: value for key, value in how.items() if key != "only"}
    with RunawayBench(wrong, commands=commands, **odd) as bench:
        partial, error = session(work, bench, only=only)
    assert_over(bench)
    (said,) = {*partial, error} - {""}
    assert "stopped: " in said
    assert cause in causes(said)
    assert ("came to rest" in said) == (wrong in (resting, resting_again))
    assert len(load_submission(work).experiments) == recorded


def test_before_the_carts_are_zeroed_they_may_be_anywhere(tmp_path):
    """Before the carts are zeroed, no position counts as too far, so nothing is stopped."""
    work = write_work(tmp_path, plan())
    with RunawayBench(lambda bench: bench.resets < 3, out=FAR) as bench:
        assert session(work, bench) == ([], "")
    assert len(load_submission(work).experiments) == 2


def test_carts_that_a_run_took_too_far_may_swing_back(tmp_path):
    """After a run stopped at the travel limit, the next run waits for rest and is recorded."""
    began: dict[str, int] = {}

    def swinging(bench: RunawayBench) -> bool:
        return resting_again(bench) and bench.ms - began.setdefault("at", bench.ms) < 50

    work = too_far(tmp_path)
    with RunawayBench(swinging, out=2 * FAR) as bench:
        (partial,), error = session(work, bench)
    assert (causes(partial), error) == (["travel"], "")
    assert [e.id for e in load_submission(work).experiments] == ["second"]


def test_a_cart_that_stays_too_far_out_is_not_driven_again(tmp_path):
    """If a cart is still too far out after a rest, the motor is not started."""
    with RunawayBench(resting_again, out=FAR) as bench:
        partial, _ = session(too_far(tmp_path), bench)
    assert re.match("stopped: .*rest.* cart 1", partial[1])
    assert bench.started_after == []


def test_an_ignored_stop_is_sent_again(tmp_path):
    """If a bench goes on after a stop command, the stop is sent again and no run is started."""
    with RunawayBench(between, duty=FULL) as bench:
        (partial,), error = session(too_far(tmp_path), bench)
    assert_over(bench)
    assert (causes(partial), causes(error)) == (["travel"], ["idle motor"])


@pytest.mark.parametrize("period", [1, 2, 5, 10])
def test_a_bench_of_few_lines_is_stopped_after_two(period):
    """However seldom a bench sends lines, it is stopped after at most two faulty ones."""
    watch = LineWatch(ordered(plan()[0], BENCH, position=PER_COUNT).rest(), carts=0, period=period)
    lines = [Reading(counts=(0, 0), target=0, duty=9, ms=ms) for ms in range(0, 100, period)]
    told = next(line.ms for line in lines if watch.check([line]))
    assert told <= AT_ONCE / 2
    assert watch.is_astray


class Pulling(Notes):
    """A person who is still pulling a cart out when the bench is stopped."""

    def __init__(self) -> None:
        super().__init__()
        self.bench: RunawayBench | None = None

    def confirm(self, instruction: str) -> None:
        """Take a long time to pull the cart out."""
        super().confirm(instruction)
        if instruction.startswith("Pull"):
            bench = self.bench
            assert bench is not None
            until(lambda: bench.stopped_at is not None, "a stop")

    def is_pulling(self, bench: RunawayBench) -> bool:
        """Return whether the cart is being pulled out."""
        return any(instruction.startswith("Pull") for instruction in self.confirmed)


def test_a_motor_that_starts_while_a_person_holds_a_cart_is_stopped(tmp_path):
    """If the motor starts while a person holds a cart, the bench is stopped at once."""
    work, notes = write_work(tmp_path, [by_hand()]), Pulling()
    with RunawayBench(notes.is_pulling, duty=FULL, commands=BY_HANDS) as notes.bench:
        (partial,), _ = session(work, notes.bench, notes=notes, only=["decay"])
    assert_over(notes.bench)
    assert partial.startswith("stopped: ")
    assert partial in notes.remarks  # before the Enter key was pressed


@pytest.mark.slow
@pytest.mark.sample
def test_a_bench_that_misbehaves_after_its_line_was_lost_is_stopped(tmp_path):
    """After a lost line is opened again, the bench is watched from its first answer on."""

    def mute(bench: RunawayBench) -> bool:
        return bench.resets == 3 and bench.lines > 800  # during the first run

    def reconnected(bench: RunawayBench) -> bool:
        return bench.resets > 4 and resting(bench)

    with RunawayBench(reconnected, duty=FULL, mute=mute) as bench:
        partial, _ = session(write_work(tmp_path, plan()), bench)
    assert_over(bench)
    assert "silent" in causes(partial[0])
    assert "rest, stopped: " in partial[-1]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("wrong", [resting, running])
def test_an_exploration_ends_if_the_bench_misbehaves(tmp_path, wrong):
    """If the bench misbehaves, an exploration ends and chooses no other experiment."""
    with RunawayBench(wrong, duty=FULL) as bench, pytest.raises(HardwareError, match="stopped: "):
        explore_bench(
            tmp_path / "new", write_diary=write_diary, port=bench.address, observer=Notes(),
            buttons=None, goal=ErrorGoal(), seconds=900.0,
        )  # fmt: skip
    assert_over(bench)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("wrong", [tried, resting, running, ended])
def test_a_stock_bench_that_misbehaves_is_stopped(tmp_path, wrong):
    """A stock bench, which answers no query, is watched as well."""
    scales = f'input = {{ unit = "V", per_count = {0.5 / FULL} }}\n'
    work = write_work(tmp_path, plan(), scales=scales, per_count=PER_COUNT)
    with RunawayBench(wrong, duty=FULL, commands=frozenset()) as bench:
        partial, error = session(work, bench)
    assert_over(bench)
    assert partial or error
