"""A person presses Stop, Skip, Keep or Repeat, and the acquiring process decides."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Action, Anomalies, Buttons, RunOutcome, Stopped
from pipeline.bench.experiments import readings_of
from pipeline.bench.live_state import LiveState
from pipeline.bench.raw import read_raw
from pipeline.experiments.plan import PlanLimits, load_plan
from pipeline.protocol import Reading
from pipeline.submission import load_submission
from tests.helpers.acquisitions import Notes, causes, sine, write_work
from tests.helpers.benches import emulator
from tests.helpers.waiting import until

NEAR = PlanLimits(input=0.5, travel=0.1)  # cm: a dwell of 0.01 V passes it within its first swing


class Finger(Notes):
    """An observer that presses a button half a second into a recording, or at its end."""

    def __init__(self, *wishes: Action, at_end: bool = False) -> None:
        super().__init__()
        self.buttons = Buttons()
        self.heeded: list[bool] = []
        self._wishes, self._at_end = list(wishes), at_end

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Press the button half a second into the recording."""
        super().readings(batch, anomalies)
        if not self._at_end and self.readings_seen[-1].ms > 500:
            self._press()

    def finished(self, outcome: RunOutcome) -> None:
        """Press the button when the run has ended."""
        super().finished(outcome)
        if self._at_end:
            self._press()

    def _press(self) -> None:
        while self._wishes:
            self.heeded.append(self.buttons.press(self._wishes.pop(0), turn=self.buttons.turn))


def record(work: Path, port: str, finger: Finger, *only: str) -> list[RunOutcome]:
    """Record the plan with this observer."""
    with suppress(Stopped):
        acquire(work, port=port, observer=finger, only=only, buttons=finger.buttons)
    return finger.outcomes


@pytest.mark.parametrize("before", [(), ("skip",), ("keep",), ("repeat",)])
def test_stop_ends_the_session_whatever_else_was_pressed(tmp_path, before, real):
    """Stop ends the session, whatever else was pressed; the data so far are partial."""
    work = write_work(tmp_path, [sine("long", seconds=30), sine("next", seconds=1)])
    finger = Finger(*before, "stop")
    with pytest.raises(Stopped):
        acquire(work, port=real.address, observer=finger, buttons=finger.buttons)
    while (ended := real.event("run"))["ended"] == "complete":
        pass
    assert ended["ended"] == "stopped"
    assert finger.heeded[-1]
    assert (work / "data" / "long.partial.txt").exists()
    assert not (work / "raw" / "next-1.raw").exists()
    assert load_submission(work).experiments == ()


def test_stop_reaches_a_stock_bench(tmp_path):
    """A bench without extensions gets a stop too, long before its own time is up."""
    scale = 'input = { unit = "V", per_count = 0.001220703125 }\n'
    dwell = sine("long", seconds=300, settle=0.3)
    work = write_work(tmp_path, [dwell], scales=scale, per_count=0.00227)
    with emulator("--stock", "--speed", "5") as bench:
        record(work, bench.address, Finger("stop"), "long")
        while (ended := bench.event("run"))["ended"] == "done":
            pass
    assert ended["lines"] < 100_000


def test_skip_goes_on_with_the_next(tmp_path, fast):
    """Skip ends the run, saves its data as partial, and asks nothing more about it."""
    work = write_work(tmp_path, [sine("long", seconds=300), sine("next", seconds=1)])
    finger = Finger("skip", "repeat")
    outcomes = record(work, fast.address, finger, "long", "next")
    assert finger.heeded == [True, False]  # one decision for each request
    assert (outcomes[0].recording.id, outcomes[0].wish) == ("long", "skip")
    assert [e.id for e in load_submission(work).experiments] == ["next"]
    assert (work / "data" / "long.partial.txt").exists()
    assert not any("long" in asked for asked in finger.confirmed)


def test_keep_saves_the_lines_so_far(tmp_path, fast):
    """Keep saves every line of the run so far, and its table says how the run ended."""
    work = write_work(tmp_path, [sine("long", seconds=300), sine("next", seconds=1)])
    outcomes = record(work, fast.address, Finger("keep"), "long", "next")
    assert [(o.recording.id, bool(o.partial)) for o in outcomes[:2]] == [
        ("long", True), ("long", False),
    ]  # fmt: skip
    kept, _ = load_submission(work).experiments
    assert (kept.id, causes(kept.note)) == ("long", ["by hand"])
    lines = readings_of(read_raw(work / "raw" / "long-1.raw"))
    text = (work / kept.file).read_text(encoding="utf-8")
    assert 500 < lines[-1].ms < 300_000
    assert len(text.splitlines()) == 1 + len(lines)
    assert not (work / "data" / "long.partial.txt").exists()


def test_repeat_begins_the_run_again(tmp_path, fast):
    """Repeat discards the first try and records the second, without a question."""
    work = write_work(tmp_path, [sine("dwell", seconds=20)])
    outcomes = record(work, fast.address, Finger("repeat"), "dwell")
    assert (outcomes[0].wish, outcomes[-1].partial) == ("repeat", "")
    assert (work / "raw" / "dwell-2.raw").exists()
    assert [e.id for e in load_submission(work).experiments] == ["dwell"]


def test_a_run_past_a_limit_is_neither_repeated_nor_kept(tmp_path, real):
    """A run that passed a limit is neither kept nor repeated, whatever is pressed."""
    for wish in ("repeat", "keep"):
        work = write_work(tmp_path / wish, [sine("dwell", seconds=4)], limits=NEAR)
        (outcome,) = record(work, real.address, Finger(wish, at_end=True), "dwell")
        assert (causes(outcome.partial), outcome.is_unsafe) == (["travel"], True)
        assert load_submission(work).experiments == ()


@contextmanager
def waits_for_a_person(work: Path, port: str) -> Iterator[tuple[LiveState, list]]:
    """Record until a person is asked; yield the shown state and a list for the outcomes.

    Afterwards the session has ended.
    """
    state, ended = LiveState(work), []

    def session() -> None:
        try:
            ended.extend(acquire(work, port=port, observer=state, only=["dwell"],
                                 buttons=state.buttons))  # fmt: skip
        except Stopped:
            ended.append("stopped")

    thread = threading.Thread(target=session)
    thread.start()
    until(lambda: state.snapshot()["instruction"])
    yield state, ended
    thread.join()


# ---------------------------------------------------------------- while a person is awaited


def test_a_run_that_broke_off_can_be_kept(tmp_path):
    """After a fault the page offers Repeat, Keep and Skip; Keep saves the lines before it."""
    work = write_work(tmp_path, [sine("dwell", seconds=2)])
    with emulator("--fault", "reset@0.6") as bench:
        with waits_for_a_person(work, bench.address) as (state, done):
            shown = state.snapshot()
            assert shown["offered"] == ["repeat", "keep", "skip"]
            assert not state.press("keep", turn=shown["turn"] - 1)  # the press is for another run
            assert state.press("keep", turn=shown["turn"])
    assert [bool(o.partial) for o in done] == [True, False]
    (kept,) = load_submission(work).experiments
    assert causes(kept.note) == ["restart", "by hand"]


@pytest.mark.parametrize("wish", ["stop", "skip"])
def test_a_run_that_waits_for_a_person_can_be_ended(tmp_path, wish):
    """If a person is asked to free the carts, Stop or Skip ends the run before the motor moves."""
    scale = 'input = { unit = "V", per_count = 0.001220703125 }\n'
    dwell = sine("dwell", seconds=2, settle=0.3)
    work = write_work(tmp_path, [dwell], scales=scale, per_count=0.00227)
    with emulator("--stock", "--speed", "5") as bench:
        with waits_for_a_person(work, bench.address) as (state, ended):
            assert "for you" in state.snapshot()["waits"]
            assert state.press(wish, turn=state.buttons.turn)
    assert [getattr(one, "wish", one) for one in ended] == ["stopped" if wish == "stop" else wish]
    assert not list(work.glob("raw/*.raw"))


@pytest.mark.parametrize("closed", [False, True])
def test_the_live_page_draws_targets_in_their_unit(closed, tmp_path):
    """A target is an input in open loop and a set point in closed loop, in the unit of its axis."""
    run = sine("dwell", seconds=2)
    scales = 'input = { unit = "V", per_count = 1e-4 }'
    live = LiveState(write_work(tmp_path, [run], scales=scales, per_count=0.002))
    live.planned(load_plan(load_submission(tmp_path)), frozenset())
    live.started(run.model_copy(update={"kind": "closed_loop"}) if closed else run)
    live.readings([Reading(counts=(300, -100), target=50, duty=20, ms=10)], Anomalies())
    (point,) = live.points(run=1, start=0)["points"]
    assert point == pytest.approx((0.01, 0.002, 0.1 if closed else 0.005, 0.6, -0.2))
