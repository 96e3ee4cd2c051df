"""The motor never stays on, whatever happens to the line, the terminal or the plan."""

import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import pytest

from pipeline.bench.events import Anomalies
from pipeline.bench.experiments import readings_of
from pipeline.bench.raw import RawHeader, RawWriter, read_raw
from pipeline.bench.run import Session
from pipeline.bench.serial_line import open_line
from pipeline.errors import ConfigError, DataError, HardwareError
from pipeline.experiments.plan import PlanLimits, StateLoop
from pipeline.protocol import (
    EXTENSIONS,
    Command,
    Description,
    Reading,
    Signal,
    Start,
    StateGains,
    Wave,
    encode,
    parse_description,
)
from pipeline.simulated.controller import ReferenceCore
from pipeline.submission import load_submission
from tests.helpers.acquisitions import (
    LIMITS,
    Notes,
    carried_out,
    causes,
    host,
    ordered,
    sine,
    until_bytes,
    write_work,
)
from tests.helpers.benches import Emulator, emulator
from tests.helpers.waiting import PATIENCE, started, until


class Alone(Notes):
    """A session without a person at the bench, in which every instruction is refused."""

    def confirm(self, instruction: str) -> None:
        """Refuse the instruction."""
        raise ConfigError(f"{instruction}: nobody")


ODD = Description(
    name="odd", encoders=2, carts=2, commands=EXTENSIONS, input_per_count=1e-4,
    position_unit="cm", position_per_count=0.002,
)  # fmt: skip


@pytest.mark.parametrize(
    ("counts", "cart"),
    [((1250, 0), 0), ((1251, 0), 1), ((-1250, 0), 0), ((-1251, 0), 1), ((0, -1300), 2)],
)
def test_a_cart_may_not_pass_either_end_of_its_travel(counts, cart):
    """`too_far` names the cart beyond 2.5 cm of 0.002 cm per count, on either side."""
    limits = PlanLimits(input=0.5, travel=2.5)
    order = ordered(sine("dwell", seconds=1), ODD, limits=limits, position=0.002)
    said = order.too_far(Reading(counts=counts, target=0, duty=0, ms=0), carts=2)
    assert [number for number in (1, 2) if f"cart {number} " in said] == [cart] * bool(cart)


@pytest.mark.parametrize(("per_count", "duty"), [(1e-4, 100), (1.005e-4, 100), (1.07e-4, 93)])
def test_the_nearest_amplitude_is_ordered(per_count, duty):
    """`make_order` rounds the amplitude of 0.01 V to the nearest count of the bench."""
    start = ordered(sine("dwell", seconds=1), ODD, per_count=per_count).commands[-1]
    assert isinstance(start, Start)
    assert start.amplitude == duty == round(0.01 / per_count)


def test_lines_that_cannot_be_read_end_a_run(tmp_path):
    """If lines cannot be read, no limit can be checked, so the motor is stopped."""
    work = write_work(tmp_path, [sine("dwell", seconds=10)])
    with emulator("--fault", "garble=1") as bench:
        (outcome,) = carried_out(work, bench.address, notes=Alone())
        sent = bench.event("run")
    assert (causes(outcome.partial), outcome.is_unsafe) == (["unreadable"], True)
    assert sent["ended"] == "stopped"
    assert sent["lines"] < 5000


def test_a_plan_for_a_stronger_bench_moves_nothing(tmp_path, real):
    """A plan for 5 V is refused on a bench of 0.5 V, and the message has both numbers."""
    strong = PlanLimits(input=5.0, travel=2.5)
    work = write_work(tmp_path, [sine("dwell", seconds=1)], limits=strong)
    with pytest.raises(ConfigError, match=r"5 V,.* 0\.5 V"):
        carried_out(work, real.address)
    with pytest.raises(queue.Empty):
        real.event("run", timeout=0.5)
    assert not (work / "raw").exists()


@pytest.mark.slow
@pytest.mark.sample
def test_an_impossible_recording_is_skipped_with_a_reason(tmp_path):
    """A chirp on a stock bench, or an amplitude below one count, is skipped with a reason.

    All other recordings are made, and the exit status is 1.
    """
    given = {"wave": "chirp", "kind": "sweep", "cycles": 1, "frequency_end": 5.0}
    chirp = sine("sweep", seconds=1).model_copy(update=given)
    faint = sine("faint", seconds=1).model_copy(update={"amplitude": 1e-5})
    scales = 'input = { unit = "V", per_count = 0.0001220703125 }\n'
    recordings = [chirp, faint, sine("dwell", seconds=1)]
    work = write_work(tmp_path, recordings, scales=scales, per_count=0.00227)
    with emulator("--stock") as bench, host(work, bench.address, "--yes") as process:
        _, said = process.communicate()
    assert process.returncode == 1
    for reason in ("sweep: the bench", "command chirp", "half a count", ": faint, sweep"):
        assert reason in said
    assert "sweep: sweep:" not in said
    assert [e.id for e in load_submission(work).experiments] == ["dwell"]


def test_a_bench_that_goes_on_after_its_run_is_stopped(tmp_path, monkeypatch, real):
    """A bench that runs more cycles than ordered, as after a changed digit, is stopped."""
    # A bench that gets no processor time near the end of its run would seem to have finished.
    monkeypatch.setattr("pipeline.bench.run._AFTER_END", PATIENCE)
    with _session(real) as (session, line):
        order = ordered(sine("dwell", seconds=20), line.bench)
        order = replace(order, recording=sine("dwell", seconds=1))
        outcome, sent = session.record(order, tmp_path / "dwell.raw"), real.event("run")
    assert (causes(outcome.partial), outcome.is_unsafe) == (["end"], True)
    assert sent["ended"] == "stopped"


@contextmanager
def _session(bench: Emulator, *, carts: int = 2, observer: Notes | None = None):
    """Yield a session on a new line, and the line."""
    with open_line(bench.address, baud=115_200) as line:
        yield Session(line, carts=carts, limits=LIMITS, observer=observer or Notes()), line


@pytest.mark.parametrize("change", [{"frequency": 3.0}, {"amplitude": 92}, {"wave": Wave.TRIANGLE}])
def test_a_changed_digit_of_a_start_is_noticed(tmp_path, monkeypatch, change, real):
    """If a digit of a start command was changed, the targets show it, and the run is repeated."""
    with _session(real) as (session, line):
        order, send = ordered(sine("dwell", seconds=2), line.bench), line.send

        def changed(*commands: Command) -> None:
            send(*(replace(c, **change) if isinstance(c, Start) else c for c in commands))

        monkeypatch.setattr(line, "send", changed)
        outcome = session.record(order, tmp_path / "dwell-1.raw")
        monkeypatch.undo()
        sent = real.event("run")
        again = session.record(order, tmp_path / "dwell-2.raw")
    assert causes(outcome.partial) == ["wave"]
    assert sent["ended"] == "stopped"
    assert sent["lines"] < 1000
    assert again.partial == ""


class Slow(Notes):
    """An observer that is slow once a cart is far out."""

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines, and hang for two seconds."""
        super().readings(batch, anomalies)
        if any(abs(count) > 22 for reading in batch for count in reading.counts):
            time.sleep(2.0)


def test_the_stop_is_sent_before_observers_are_called(tmp_path, real):
    """The motor is stopped even if an observer hangs at the line that passes the limit."""
    raw, near = tmp_path / "dwell-1.raw", PlanLimits(input=0.5, travel=22 * 0.00227)
    with _session(real, observer=Slow()) as (session, line):
        order = ordered(sine("dwell", seconds=4), line.bench, limits=near)
        outcome, sent = session.record(order, raw), real.event("run")
    assert causes(outcome.partial) == ["travel"]
    assert sent["ended"] == "stopped"
    offending = next(r.ms for r in readings_of(read_raw(raw)) if max(map(abs, r.counts)) > 22)
    assert 1.0024 * sent["lines"] - offending < 1000


def test_every_cart_of_the_bench_is_watched(tmp_path, real):
    """On a bench of two carts, both are watched even if the submission has only one."""
    # At the second resonance, near 6 Hz, the second cart moves twice as far as the first.
    dwell = sine("dwell", seconds=8, frequency=6.0)
    dwell = dwell.model_copy(update={"carts": (1,), "amplitude": 0.02})
    near = PlanLimits(input=0.5, travel=0.25)
    with _session(real, carts=1) as (session, line):
        order = ordered(dwell, line.bench, limits=near, carts=1)
        outcome = session.record(order, tmp_path / "dwell-1.raw")
    assert causes(outcome.partial) == ["travel"]
    assert "cart 2" in outcome.partial


@pytest.mark.slow
@pytest.mark.sample
def test_a_new_line_is_zeroed_once_the_carts_rest(tmp_path, real):
    """If the line is opened while carts swing, they are zeroed again once they are at rest."""
    notes, heard = Notes(), bytearray()
    with _session(real, observer=notes) as (session, line):
        line.send(Start(wave=Wave.SQUARE, frequency=0.5, amplitude=400))

        def away() -> bool:
            heard.extend(line.receive())
            *whole, _ = heard.split(b"\n")
            return bool(whole) and int(whole[-1].split(b":")[0]) > 100

        until(away, "a swing")  # at the latest after one second
        line.send(Signal.RESET)  # every session starts with this
        line.drain()
        order = ordered(sine("dwell", seconds=1, settle=3.0), line.bench)
        assert session.prepare(order) == ""
        session.record(order, tmp_path / "dwell-1.raw")
    assert max(map(abs, notes.readings_seen[0].counts)) <= 4  # as a cart at rest may flicker


class Answers(threading.Thread):
    """A port that answers each query with the next of the given answers."""

    def __init__(self, answers: Iterable[bytes]) -> None:
        super().__init__(daemon=True)
        self._answers = iter(answers)
        self._door = socket.create_server(("127.0.0.1", 0))
        self.address = f"socket://127.0.0.1:{self._door.getsockname()[1]}"
        self.start()

    def run(self) -> None:
        """Serve one host until it hangs up."""
        peer, _ = self._door.accept()
        with self._door, peer:
            while heard := peer.recv(4096):
                for _ in range(heard.count(b"?;")):
                    peer.sendall(next(self._answers))


def test_a_description_must_arrive_twice():
    """The host asks for the bench's description until two answers agree, as one may be damaged.

    If no two answers agree, the error says to check the cable.
    """
    true = DESCRIPTION.encode() + b"\n"
    wrong = [true.replace(b"0.002cm", b"0.00%dcm" % digit) for digit in (1, 3, 6)]
    with open_line(Answers([wrong[0], true, true]).address, baud=115_200) as line:
        assert line.bench.position_per_count == 0.002
    with pytest.raises(HardwareError, match="differently"):
        open_line(Answers([*wrong, true]).address, baud=115_200)


def test_a_run_starts_only_after_both_answers():
    """Before a run the host waits for late answers to its queries, so that no byte is left over.

    One damaged answer, here with a stray byte before it, is no error.
    """
    described = DESCRIPTION.encode() + b"\n"

    def answers() -> Iterator[bytes]:
        yield from (described, described)  # answers in the handshake
        time.sleep(0.8)
        yield described
        time.sleep(0.1)
        yield b"1:1:0:0:7\n" + described
        yield b"#" + described
        yield described

    with open_line(Answers(answers()).address, baud=115_200) as line:
        line.clear()
        time.sleep(0.3)
        assert line.receive() == b""
        line.clear()


@pytest.fixture
def _hearing() -> Iterator[None]:
    """Let programs started by a test end with their terminal, even if pytest runs under nohup.

    A program inherits the signal that nohup ignores, but not a handler that does nothing.
    """
    before = signal.signal(signal.SIGHUP, lambda number, frame: None)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows neither signal")
@pytest.mark.usefixtures("_hearing")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_host_stops_the_motor_and_saves(tmp_path, number, real):
    """Ctrl-C, SIGTERM or a closed terminal ends a run by a stop command, and its data are saved."""
    work = write_work(tmp_path, [sine("dwell", seconds=30)])
    with host(work, real.address, "--only", "dwell") as process:
        until_bytes(work / "raw" / "dwell-1.raw", process)
        process.send_signal(number)
        _, said = process.communicate()
    assert real.event("run")["ended"] == "stopped"
    assert process.returncode == 130
    assert "repeat the command" in said or number == signal.SIGHUP
    assert (work / "data" / "dwell.partial.txt").exists()
    assert load_submission(work).experiments == ()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot limit file sizes")
def test_a_full_disk_stops_the_motor_and_says_what_to_do(tmp_path, real):
    """If the disk is full, the run ends by a stop command, and the message names the folder."""
    work = write_work(tmp_path, [sine("dwell", seconds=30)])
    command = 'ulimit -f 20; exec "$0" -m pipeline acquire "$1" --port "$2" --only dwell'
    shell = ["sh", "-c", command, sys.executable, work, real.address]
    with started(shell, stderr=subprocess.PIPE, encoding="utf-8") as process:
        _, said = process.communicate()
    assert real.event("run")["ended"] == "stopped"
    assert process.returncode == 2
    assert f"{work}; free" in said
    assert "--out" not in said


DESCRIPTION = (
    "?cartlab/1 name=b encoders=2 carts=2 period=0.001 baud=115200 commands=sk "
    "input=0.001V position=0.002cm"
)


@pytest.mark.parametrize(
    ("stated", "wrong"),
    [("position=0.002cm", "position=0cm"), ("position=0.002cm", "position=nancm"),
     ("input=0.001V", "input=1e999V"), ("period=0.001", "period=nan"),
     ("encoders=2", "encoders=9"), ("carts=2", "carts=0")],
)  # fmt: skip
def test_a_description_with_a_useless_scale_is_refused(stated, wrong):
    """A description with an impossible scale, period or number is refused: no limit would hold."""
    assert parse_description(DESCRIPTION.encode()).carts == 2
    with pytest.raises(DataError, match=wrong):
        parse_description(DESCRIPTION.replace(stated, wrong).encode())


def test_more_than_the_bench_can_give_is_refused():
    """An amplitude beyond full scale is refused, as it would be clipped."""
    bench = Description(name="b", encoders=2, carts=2)
    least = sine("dwell", seconds=1).model_copy(update={"amplitude": 0.4096})
    assert ordered(least, bench, per_count=1e-4).commands
    with pytest.raises(ConfigError, match=r"0\.41 V"):
        ordered(least.model_copy(update={"amplitude": 0.41}), bench, per_count=1e-4)


def test_no_earlier_gains_act_after_a_lost_byte():
    """A gain command that lost a letter or a semicolon does nothing.

    Gains sent earlier do not act either.
    """
    bench = Description(name="b", encoders=2, carts=2, commands=EXTENSIONS)
    loop = sine("loop", seconds=1).model_copy(update={"controller": StateLoop()})
    gains = StateGains(gains=(0.5, 0.0, 0.0, 0.0), prefilter=0.5)
    order = ordered(loop, bench, per_count=1e-4, gains=gains)
    *before, told, start = (encode(command) for command in order.commands)
    for lost in (at for at, byte in enumerate(told) if byte in b"f;"):
        core = ReferenceCore(bench)
        core.receive(encode(StateGains(gains=(5.0, 0.0, 0.0, 0.0), prefilter=5.0)))
        core.receive(b"".join([*before, told[:lost], told[lost + 1 :], start]))
        assert {core.tick((0, 0), stamp=ms, now=0) for ms in range(200)} == {0}


# ----------------------------------------------------------------- files of others


def _header(name: str) -> RawHeader:
    dwell, bench = sine(name, seconds=1), Description(name="b", encoders=2, carts=2)
    return RawHeader(recording=dwell, limits=LIMITS, commands=(), bench=bench, begun="")


def test_nothing_is_written_outside_or_over_the_data_of_others(tmp_path, fast):
    """Neither the path in a raw file nor a plan's id can make cartlab write to another file."""
    work = write_work(tmp_path / "a" / "work", [sine("dwell", seconds=1)])
    (work / "data").mkdir()
    mine = work / "data" / "dwell.txt"
    mine.write_text("mine", encoding="utf-8")
    header = _header("x")
    recording = header.recording.model_copy(update={"id": "../../elsewhere"})
    with RawWriter(work / "raw" / "x-1.raw", replace(header, recording=recording)) as raw:
        raw.write(b"".join(b"0:0:0:0:%d\n" % ms for ms in range(20)))
    with (work / "submission.toml").open("a", encoding="utf-8") as file:
        file.write("""\n[[experiments]]\nid = "first"\nkind = "step"\nfile = "data/dwell.txt"\n""")
    with pytest.raises(ConfigError, match="'first'"):
        carried_out(work, fast.address)
    assert mine.read_text(encoding="utf-8") == "mine"
    assert not list(tmp_path.rglob("elsewhere*"))


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
def test_a_raw_file_is_not_written_through_a_link(tmp_path):
    """A link in place of a run's time file is replaced, and its target stays as it is."""
    mine = tmp_path / "mine"
    mine.write_text("mine", encoding="utf-8")
    (tmp_path / "dwell-1.times").symlink_to(mine)
    with RawWriter(tmp_path / "dwell-1.raw", _header("dwell")) as raw:
        raw.write(b"0:0:0:0:0\n")
    assert mine.read_text(encoding="utf-8") == "mine"
    assert (tmp_path / "dwell-1.times").stat().st_size == 16


# ----------------------------------------------------------------- at the keyboard

ASK = """from pathlib import Path
from pipeline.bench.terminal import Terminal
Terminal(Path()).confirm('Hold cart 1')
print('held')"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
@pytest.mark.parametrize(("typed", "held"), [(b"\n", True), (b"\x04", False)])
def test_only_a_later_enter_answers_the_question(typed, held):
    """Only an Enter typed after the question starts the motor, and Ctrl-D means no."""
    controller, terminal = os.openpty()
    pipes = {"stdin": terminal, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started([sys.executable, "-c", ASK], **pipes, encoding="utf-8") as process:
        os.write(controller, b"\n\n")
        assert process.stderr is not None
        while (heard := process.stderr.read(1)) != ")":
            assert heard, "nothing was asked"
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=1)
        os.write(controller, typed)
        said, complaint = process.communicate()
    os.close(controller)
    os.close(terminal)
    assert ("held" in said) is held
    assert ("keyboard was closed" in complaint) is not held
