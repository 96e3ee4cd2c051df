"""`acquire` carries out a plan on a virtual bench over a real line."""

import json
import os
import sys
import threading
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Anomalies, RunOutcome
from pipeline.bench.experiments import prepare_submission, readings_of
from pipeline.bench.raw import read_raw
from pipeline.bench.run import Session
from pipeline.bench.serial_line import open_line
from pipeline.bench.terminal import Terminal, sparkline
from pipeline.cli import app
from pipeline.errors import ConfigError, HardwareError
from pipeline.experiments.plan import Plan, Recording, StateLoop
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS
from pipeline.protocol import Description, Reading
from pipeline.submission import StateFeedbackController, load_submission
from pipeline.workflow import analyse
from tests.helpers.acquisitions import (
    LIMITS,
    Notes,
    carried_out,
    causes,
    decay,
    host,
    ordered,
    sine,
    until_bytes,
    write_work,
)
from tests.helpers.benches import emulator
from tests.helpers.waiting import started, until


def last_run(bench) -> dict:
    """Wait until a stop or the watchdog has ended a run; return the bench's report of it."""
    while (sent := bench.event("run"))["ended"] not in ("stopped", "watchdog"):
        pass
    return sent


# ----------------------------------------------------------------- a whole session


def test_a_plan_becomes_a_submission(tmp_path, fast):
    """Decays, a dwell and a closed loop of a plan each get a file and a table in the right units.

    The virtual bench holds and releases its carts itself, so no person is asked. Existing comments
    are kept.
    """
    both = {"carts": (1, 2), "wave": "square"}
    loop = Recording(
        id="control", kind="closed_loop", amplitude=0.3, frequency=0.25,
        controller=StateLoop(gains=(0.01, 0.002, 0.0, 0.0), prefilter=0.05), **both,
    )  # fmt: skip
    # The carts must be identified before their loop is closed: a step and a sweep suffice.
    step = Recording(id="step", kind="step", amplitude=0.02, frequency=0.1, settle=0.5, **both)
    work = write_work(tmp_path / "work", [decay("decay-1"), step, sine("dwell", seconds=8), loop])
    names, notes = ["decay-1", "step", "dwell", "control"], Notes()
    outcomes = carried_out(work, fast.address, *names, notes=notes)
    assert [outcome.recording.id for outcome in outcomes if not outcome.partial] == names
    assert all(asked.endswith("again") for asked in notes.confirmed)  # if the host was busy
    submission = load_submission(work)
    assert "# ours" in (work / "submission.toml").read_text(encoding="utf-8")
    assert submission.system.position.per_count == 0.00227
    records = {record.id: record for record in read_data(submission).records}
    # Without friction, 0.02 V move the first cart of throne-2dof by 0.486 cm, at 24.3 cm per volt.
    assert records["step"].y[0].max() > 0.45
    assert records["decay-1"].free == (1,)
    assert np.ptp(records["decay-1"].y[1]) == 0.0  # held
    assert np.ptp(records["decay-1"].y[0]) > 1.5
    assert records["dwell"].omega == pytest.approx(2 * np.pi * 2.0)
    reference = records["control"].reference
    assert reference is not None
    # An amplitude is sent in whole counts of 0.00227 cm.
    assert reference.max() == pytest.approx(0.3, abs=0.5 * 0.00227)
    controller = next(e.controller for e in submission.experiments if e.id == "control")
    assert isinstance(controller, StateFeedbackController)
    # Commands carry nine digits, the table has six.
    assert controller.gains == pytest.approx((0.01, 0.002, 0.0, 0.0), rel=1e-5)


def test_existing_recordings_are_skipped(tmp_path, fast):
    """A second session records only what is missing."""
    work, notes = write_work(tmp_path, [sine("a", seconds=1), sine("b", seconds=1)]), Notes()
    first = carried_out(work, fast.address, "a")
    second = carried_out(work, fast.address, "a", "b", notes=notes)
    assert [{o.recording.id for o in made} for made in (first, second)] == [{"a"}, {"b"}]
    assert notes.plans == [(2, frozenset("a"))]
    assert [e.id for e in load_submission(work).experiments] == ["a", "b"]


@pytest.mark.slow
@pytest.mark.sample
def test_a_stock_bench_is_driven_by_people(tmp_path):
    """On a stock bench a person holds the carts, and no watchdog guards the motor."""
    work = write_work(tmp_path, [sine("dwell", seconds=1, settle=0.3)], per_count=0.00227)
    notes = Notes()
    with emulator("--stock", "--speed", "5", "--period", "5.003") as bench:
        *_, outcome = carried_out(work, bench.address, notes=notes)
    assert outcome.partial == ""
    assert notes.confirmed[0] == "All carts free"
    assert any("watchdog" in remark for remark in notes.remarks)
    (record,) = read_data(load_submission(work)).records
    assert record.input_scale == 5 / 4096


@pytest.mark.slow
@pytest.mark.sample
def test_the_whole_cycle_finds_the_hidden_effect(tmp_path):
    """Plan, recordings, report and gap analysis find the dry friction hidden in a virtual bench."""
    work, hidden = tmp_path / "work", "coulomb_friction:cart=1,force=0.0025"
    with emulator("--hide", hidden, "--speed", "20", "--period", "8.84") as bench:
        names = ("decay-1a", "decay-2a", "step-1", "step-2", "sweep")
        outcomes = carried_out(work, bench.address, *names)
    assert {o.recording.id for o in outcomes if not o.partial} >= {"decay-1a", "step-1", "sweep"}
    runner = CliRunner()
    assert runner.invoke(app, ["report", str(work), "--no-pdf"]).exit_code in (0, 1)
    assert runner.invoke(app, ["gap", str(work), "--no-pdf"]).exit_code == 0
    gap = json.loads((work / "gap" / "gap.json").read_text(encoding="utf-8"))
    assert gap["verdict"] == "named"
    (effect,) = gap["effects"]
    assert (effect["effect"], effect["where"]) == ("coulomb_friction", {"cart": 1})
    force = effect["parameters"]["force"]
    assert abs(force["value"] - 0.0025) < 4 * force["std"]
    assert gap["gap"]["final"] < 1.5 * gap["gap"]["noise_floor"]


# ----------------------------------------------------------------- what goes wrong


@pytest.mark.slow
@pytest.mark.sample
def test_faults_of_every_kind_are_counted_and_the_rest_is_kept(tmp_path):
    """With 1 % of the lines damaged in each way, good lines are kept and faults counted."""
    work = write_work(tmp_path, [sine("dwell", seconds=8)])
    options = [o for kind in ("drop", "garble", "merge") for o in ("--fault", f"{kind}=0.01")]
    with emulator(*options, "--speed", "10") as bench:
        *_, outcome = acquire(work, port=bench.address, observer=Notes(), only=["dwell"])
        while (sent := bench.event("run"))["ended"] != "done" or sent["lines"] < 7000:
            pass
    struck = sent["injected"]
    spoilt = struck["drop"] + struck["garble"] + 2 * struck["merge"]
    assert outcome.lines == sent["lines"] - spoilt
    assert outcome.anomalies.garbled == struck["garble"] + struck["merge"]
    # At the very beginning or end of a run, a lost line leaves no gap in the stamps.
    assert abs(outcome.anomalies.lost - struck["drop"]) <= 2
    submission = load_submission(work)
    assert f"{outcome.anomalies.garbled} garbled" in submission.experiments[0].note
    # The record is as good as a complete one: it gives the preset's gains at this frequency.
    points = analyse(submission).sine_points
    true = np.abs(PRESETS["throne-2dof"].frequency_response(np.array([points[0].omega])))[:, 0]
    for point in points:
        # The input of 10 mV is sent in counts of 0.12 mV; stamps are accurate to half a ms in 500.
        assert point.gain == pytest.approx(true[point.cart - 1], rel=3e-3)


@pytest.mark.parametrize(("fault", "why"), [("reset", "restart"), ("disconnect", "line")])
def test_a_run_that_breaks_off_is_saved_as_partial_and_recorded_again(tmp_path, fault, why):
    """A run that breaks off is saved as partial, where no report reads it, and is repeated.

    The second try succeeds.
    """
    work, notes = write_work(tmp_path, [sine("dwell", seconds=2)]), Notes()
    with emulator("--fault", f"{fault}@0.6") as bench:
        outcomes = carried_out(work, bench.address, notes=notes)
    assert [causes(o.partial) for o in outcomes] == [[why], []]
    (asked,) = notes.confirmed  # the request to record again contains the reason
    assert outcomes[0].partial in asked
    assert (work / "data" / "dwell.partial.txt").exists()
    assert [e.file for e in load_submission(work).experiments] == ["data/dwell.txt"]
    partial = readings_of(read_raw(work / "raw" / "dwell-1.raw"))
    assert partial[-1].ms == pytest.approx(600, abs=20)


def test_a_run_that_passes_the_input_limit_is_stopped_at_once(tmp_path, real):
    """A run that passes the input limit is stopped at once, whatever program set the input."""
    raw = tmp_path / "dwell-1.raw"
    with open_line(real.address, baud=115_200) as line:
        order = ordered(sine("dwell", seconds=4), line.bench)
        session = Session(line, carts=2, limits=LIMITS, observer=Notes())
        outcome = session.record(replace(order, most_duty=50), raw)
        assert last_run(real)["ended"] == "stopped"
    run = read_raw(raw)
    offending = next(r.ms for r in readings_of(run) if abs(r.duty) > 50)
    assert causes(outcome.partial) == ["input"]
    # The port was not read again after the offending line was found.
    *_, last = [lump for lump, _ in run.lumps()]
    seen = readings_of(replace(run, content=run.content[: -len(last)], arrivals=run.arrivals[:-1]))
    assert not seen or offending >= seen[-1].ms


@pytest.mark.slow
@pytest.mark.sample
def test_a_killed_host_leaves_a_readable_file_and_a_motor_that_is_off(tmp_path, fast):
    """After `kill -9` the watchdog stops the motor, and the file lacks only the latest lines."""
    work, notes = write_work(tmp_path, [sine("dwell", seconds=10)]), Notes()
    with emulator(watchdog=2.0) as bench:
        with host(work, bench.address, "--only", "dwell", "--yes") as process:
            until_bytes(work / "raw" / "dwell-1.raw", process, least=20_000)
            process.kill()
        silent = bench.event("motor off")["ms_after_heartbeat"]
        sent = last_run(bench)["lines"]
    kept = readings_of(read_raw(work / "raw" / "dwell-1.raw"))
    assert silent >= 1999
    # The bench sent lines until its watchdog acted. Of those up to its last heartbeat, only lines
    # that a busy machine had not yet delivered may be missing.
    assert kept[-1].ms > 1.0024 * sent - silent - 500
    *_, outcome = carried_out(work, fast.address, notes=notes)
    assert outcome.partial == ""
    assert any("data/dwell.partial.txt" in remark for remark in notes.remarks)


# ----------------------------------------------------------------- ports and scales


def test_a_port_without_a_bench_is_reported():
    """If nothing listens at a port, one line says what to do."""
    with pytest.raises(HardwareError, match="listens there; start"):
        open_line("socket://127.0.0.1:9", baud=115_200)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_a_device_that_is_not_a_bench_is_reported():
    """If a device does not answer like a bench, the message says so."""
    controller, device = os.openpty()
    echo = f"import os\nwhile os.read({controller}, 99): os.write({controller}, b'login: ')"
    try:
        with started([sys.executable, "-c", echo], pass_fds=[controller]):
            with pytest.raises(HardwareError, match="not a line"):
                open_line(os.ttyname(device), baud=115_200)
    finally:
        os.close(controller)
        os.close(device)


BENCH = Description(
    name="b", encoders=2, carts=2, commands=frozenset("sk"), position_unit="cm",
    position_per_count=0.00227,
)  # fmt: skip


def test_scales_are_added_without_touching_the_rest(tmp_path):
    """The bench's scales are added to [system], and all comments and the order of keys stay."""
    text = """# first
version = 1  # one

[system]  # the bench
carts = 2
position = { unit = "cm" } # not yet scaled

[design]
cart = 1
"""
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    submission = prepare_submission(tmp_path, BENCH, stock=False)
    assert submission.system.position.per_count == 0.00227
    assert submission.system.input.per_count == 5 / 4096
    new = (tmp_path / "submission.toml").read_text(encoding="utf-8")
    for line in text.splitlines():
        assert line.partition(" }")[0] in new


@pytest.mark.parametrize("stock", [True, False])
def test_an_unknown_scale_is_asked_for(tmp_path, stock):
    """If the bench does not state its units, one line says what to add to the submission."""
    text = 'version = 1\n[system]\ncarts = 2\nposition = { unit = "mm" }\n'
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    wanted = r'position = \{ unit = "mm", per_count = … \} under \[system\]'
    with pytest.raises(ConfigError, match=wanted):
        prepare_submission(tmp_path, BENCH, stock=stock)


# ----------------------------------------------------------------- the terminal


def shown(folder: Path, *, terminal: bool, **options) -> tuple[Terminal, StringIO]:
    """Return a terminal view and the text that it prints."""
    out = StringIO()
    console = Console(file=out, force_terminal=terminal, width=100)
    return Terminal(write_work(folder / "work", []), console=console, **options), out


def test_the_terminal_shows_progress_faults_and_positions(tmp_path):
    """During a run the terminal shows progress, lost lines and where the carts are."""
    view, out = shown(tmp_path, terminal=True)
    plan = Plan(limits=LIMITS, recordings=(sine("a", seconds=30), sine("b", seconds=45)))
    with view:
        view.planned(plan, frozenset("a"))
        view.started(plan.recordings[1])
        for ms in range(0, 2000, 50):
            batch = [Reading(counts=(ms, -ms), target=0, duty=0, ms=ms + i) for i in range(50)]
            view.readings(batch, Anomalies(lost=7, stuck=1))
    found = [
        out.getvalue().find(words) > 0 for words in ("1 of 2", "43 s", "2.0 of 45.0", "7 lines")
    ]
    assert found == [True] * 4
    assert sparkline(range(0, 2000, 50)) in out.getvalue()


def test_without_a_terminal_only_bad_runs_are_reported(tmp_path):
    """In a log file a good run leaves no line, and a bad run leaves its reason."""
    view, out = shown(tmp_path, terminal=False)
    well, why = (
        RunOutcome(recording=sine("a", seconds=1), lines=998),
        "stopped: cart 1 [b] was too far",
    )
    with view:
        view.planned(Plan(limits=LIMITS, recordings=(well.recording,)), frozenset())
        view.started(well.recording)
        view.readings([Reading(counts=(1, 2), target=0, duty=0, ms=5)], Anomalies())
        view.finished(well)
        assert out.getvalue() == ""
        view.finished(replace(well, partial=why))
    assert out.getvalue() == f"a: {why}\n"


def test_without_a_keyboard_nothing_is_confirmed(tmp_path, monkeypatch):
    """Without a keyboard an instruction ends the session, unless `--yes` is given."""
    monkeypatch.setattr("sys.stdin", StringIO())
    view, _ = shown(tmp_path, terminal=False)
    with pytest.raises(ConfigError, match="Hold it: nobody"):
        view.confirm("Hold it")
    view, out = shown(tmp_path, terminal=False, yes=True)
    view.confirm("Hold it")
    assert "Hold it: confirmed" in out.getvalue()


def test_with_a_page_the_terminal_waits_for_its_answer(tmp_path):
    """Terminal and page show one session: the page's answer counts, and both tell the remarks."""
    view, out = shown(tmp_path, terminal=False, has_page=True)
    waiting = threading.Thread(target=view.confirm, args=("Hold it",))
    waiting.start()
    until(lambda: view.snapshot()["instruction"] == {"number": 1, "text": "Hold it"})
    view.remark("no watchdog")
    assert view.apply("done", 1)
    waiting.join()
    assert view.snapshot()["remarks"] == ["no watchdog"]
    assert out.getvalue() == "no watchdog\n"
