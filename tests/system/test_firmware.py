"""The firmware's C core sends the same bytes as the reference controller in Python."""

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.protocol import (
    FULL_SCALE,
    ChirpEnd,
    Description,
    PidGains,
    Signal,
    Start,
    StateGains,
    Wave,
    encode,
    parse_description,
    parse_reading,
)
from pipeline.simulated.controller import ReferenceCore
from pipeline.simulated.emulator import EmulatorOptions, Server
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.firmware_host import (
    COMPILER,
    FIRMWARE,
    SOURCES,
    FirmwareCore,
    acquire,
    build_library,
    compile_c,
    kept_going,
)

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler is here")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return build_library(tmp_path_factory.mktemp("firmware"))


def _description(encoders=2):
    return Description(name="test", encoders=encoders, carts=encoders, commands=frozenset("cfks"))


def _both(library, encoders=2):
    description = _description(encoders)
    return FirmwareCore(library, description), ReferenceCore(description)


# ------------------------------------------------------------- equal to the reference

FREQUENCIES = st.floats(1e-3, 1e3) | st.floats(0.1, 10.0)
GAINS = st.floats(-1e3, 1e3) | st.sampled_from([0.0, 1e9, -1e9, 1e-9])
STARTS = st.builds(
    Start,
    wave=st.sampled_from(Wave),
    encoder=st.sampled_from([None, 1, 2]),
    frequency=FREQUENCIES,
    amplitude=st.integers(-6000, 6000) | st.sampled_from([-1_000_000, 1_000_000]),
    cycles=st.integers(1, 1000),
)
COMMANDS = st.one_of(
    STARTS,
    st.builds(PidGains, kp=GAINS, ki=GAINS, kd=GAINS),
    st.builds(
        StateGains, gains=st.lists(GAINS, min_size=4, max_size=6).map(tuple), prefilter=GAINS
    ),
    st.builds(ChirpEnd, frequency=FREQUENCIES),
    st.sampled_from(Signal),
).map(encode)


@st.composite
def _damaged(draw):
    """Draw commands with a byte lost, added or changed."""
    data = bytearray(b"".join(draw(st.lists(COMMANDS, min_size=1, max_size=3))))
    at = draw(st.integers(0, len(data) - 1))
    data[at : at + draw(st.integers(0, 1))] = draw(st.binary(max_size=1))
    return bytes(data)


BYTES = COMMANDS | _damaged() | st.text("dgfczskh?;qtwo01.+-e \n", max_size=40).map(str.encode)
TICKS = st.tuples(
    st.lists(st.integers(-3000, 3000), min_size=3, max_size=3),
    st.integers(0, 60),  # ms until the next tick
)


@pytest.mark.slow
@pytest.mark.sample
@given(
    encoders=st.sampled_from([2, 3]),
    session=st.lists(st.tuples(BYTES, st.lists(TICKS, max_size=12)), max_size=8),
)
@example(encoders=2, session=[(b"?;?;?;d;s;o;o;1;5;1;", [([0, 0, 0], 1)])])
@settings(max_examples=200)
def test_any_session_equals_that_of_the_reference(library, encoders, session):
    """Whatever bytes arrive, firmware and reference give the same duties and lines.

    The host reads after each byte here, because the firmware drops lines for which its buffer has
    no room. The reference has room for all lines, and sends them at its next tick.
    """
    firmware, reference = _both(library, encoders)
    stamp, sent = 0, b""
    for data, ticks in session:
        for at in range(len(data)):
            firmware.receive(data[at : at + 1])
            sent += firmware.take()
        reference.receive(data)
        for counts, interval in ticks:
            stamp += interval
            clocks = {"stamp": stamp, "now": 2 * stamp}
            counts = counts[:encoders]
            assert firmware.tick(counts, **clocks) == reference.tick(counts, **clocks)
            assert sent + firmware.take() == reference.take()
            sent = b""


def chirp(frequency: float, encoder: int | None = None) -> Start:
    """Return a chirp of a few seconds."""
    return Start(wave=Wave.CHIRP, encoder=encoder, frequency=frequency, amplitude=1500, cycles=8)


RUNS = [
    *((encode(Start(wave=wave, frequency=3.7, amplitude=4321, cycles=37)), 10_000)
      for wave in Wave if wave != Wave.MULTISINE),
    *((encode(ChirpEnd(frequency=end)) + encode(chirp(2.0)), 4000) for end in (0.5, 2.0, 30.0)),
    # After a reset a chirp has its default end, and a closed loop has gains of zero.
    (encode(PidGains(kp=1.0, ki=0.0, kd=0.0)) + encode(ChirpEnd(frequency=2.0)) + b"z;"
     + encode(chirp(1.0, encoder=1)), 1000),
    (encode(Start(wave=Wave.SQUARE, frequency=1.0, amplitude=-5000)), 1000),  # beyond full scale
]  # fmt: skip


@pytest.mark.parametrize(("commands", "ticks"), RUNS, ids=range(len(RUNS)))
def test_whole_runs_equal_those_of_the_reference(library, commands, ticks):
    """For each wave, chirp and reset, firmware and reference send equal lines and duties."""
    firmware, reference = _both(library)
    for core in (firmware, reference):
        core.receive(commands)
    duties, lines = set(), 0
    for stamp in range(ticks + 2):
        duty = firmware.tick((stamp, -stamp), stamp=stamp, now=stamp)
        assert duty == reference.tick((stamp, -stamp), stamp=stamp, now=stamp)
        line = firmware.take()
        assert line == reference.take()
        duties.add(duty)
        lines += bool(line)
    assert lines >= ticks
    assert max(map(abs, duties)) <= FULL_SCALE
    assert (duties == {0}) == (b"z;" in commands)


@pytest.mark.parametrize(
    "gains",
    [PidGains(kp=2.0, ki=3.0, kd=0.05), StateGains(gains=(3.0, 0.2, -1.0, 0.1), prefilter=2.0)],
)
def test_loops_equal_those_of_the_reference(library, gains):
    """With both control laws, firmware and reference agree on a bench that moves."""
    firmware, reference = _both(library)
    start = Start(wave=Wave.SQUARE, encoder=1, frequency=1.0, amplitude=700, cycles=3)
    for core in (firmware, reference):
        core.receive(encode(gains) + encode(start))
    x = v = 0.0
    for stamp in range(3000):
        counts = (round(x), round(x / 3))
        duty = firmware.tick(counts, stamp=stamp, now=stamp)
        assert duty == reference.tick(counts, stamp=stamp, now=stamp)
        assert firmware.take() == reference.take()
        v += 1e-3 * (30.0 * duty - 2.0 * v)
        x += 1e-3 * v
    assert abs(x) > 100  # the loop moved the mass


# ----------------------------------------------------------------- a whole bench

SUBMISSION = """
version = 1
[system]
carts = 1
position = { unit = "cm" }
[design]
cart = 1
reference = 0.5
overshoot_percent = 10.0
settling_time = 0.8
"""
PLAN = """
version = 1
[limits]
input = 0.5
travel = 2.5
[[recordings]]
id = "step"
kind = "step"
carts = [1]
wave = "square"
amplitude = 0.03
frequency = 0.25
settle = 0.1
[[recordings]]
id = "control"
kind = "closed_loop"
carts = [1]
wave = "square"
amplitude = 0.5
frequency = 0.5
settle = 0.1
controller = { type = "state_feedback", cart = 1 }
"""


class PatientWatchdog(FirmwareCore):
    """A controller whose watchdog waits 10 s for a host on a busy machine."""

    def tick(self, counts: Sequence[int], *, stamp: int, now: int) -> int:
        """Advance by one tick, and return the duty count that acts from now on."""
        return super().tick(counts, stamp=stamp, now=now // 100)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_acquire_records_with_the_firmware(library, tmp_path):
    """`acquire` records a step from firmware on a pty with simulated carts, then a closed loop."""
    (tmp_path / "submission.toml").write_text(SUBMISSION, encoding="utf-8")
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    bench = prepare_bench(preset="throne-1dof")
    server = Server(bench, EmulatorOptions(port="pty"), core=partial(PatientWatchdog, library))
    with closing(server), kept_going(lambda until: server.serve(until=until)):
        acquire(tmp_path, port=server.address, only=["step", "control"])
    analysis = analyse(load_submission(tmp_path))
    loop = next(check for check in analysis.hardware if check.loop == "closed")
    # Noise and rounding are 0.2 % of the motion, and the model is accurate to about 1 %. Gains in
    # wrong units, or for the wrong encoder, would be off by tens of percent.
    assert loop.nrmse < 0.02
    assert loop.settling_measured is not None
    assert loop.settling_measured < 0.8  # s, the settling time of the design


# ------------------------------------------------------------------- guards


def test_the_motor_is_cut_100_ms_after_the_last_heartbeat(library):
    """Once armed by a heartbeat, the watchdog cuts the motor after 100 ms; a reset disarms it."""
    core, _ = _both(library)
    start = encode(Start(wave=Wave.SQUARE, frequency=1e-3, amplitude=-900))
    core.receive(start)

    def duty(now):
        return core.tick((0, 0), stamp=600_000 + now if now else 0, now=now)

    assert (duty(0), duty(5000)) == (0, -900)  # not armed
    core.receive(b"k;")
    assert (duty(5010), duty(5109), duty(5110)) == (-900, -900, 0)
    core.receive(b"k;")
    assert duty(5111) == 0  # a heartbeat alone does not start the motor
    core.receive(b"z;" + start)
    assert core.tick((0, 0), stamp=0, now=9000) == 0
    assert core.tick((0, 0), stamp=600_000, now=9900) == -900


STOPPING = [
    b"s;", b";s;", b"z;", b"\r\n s\t;", b"d;q;o;s;", b"d;s;k;", b"d;s;;", b"g;1;s;",
    b"noises;", b"noisez;", b"9" * 50 + b"s;",
    b"\r\nd; q;o\r;\no;\t1 ;5;1;",  # a start command; the first half period of its wave is zero
]  # fmt: skip
NOT_STOPPING = [
    b"s", b"d;s;", b"k;", b"?;", b"noise;", b"ss k;", b"s\x00;", b"d;s;o;o;1;5;0;",
    b"d;q;o;o;1;" + b"0" * 40 + b"5;1;", b"d;q;o;o;9e-4;5;1;", b"d;q;o;o;1001;5;1;",
    b"d;q;o;o;1;1000001;1;", b"d;q;o;o;1;5.0;1;", b"d;q;o;o;1;5;1000001;",
]  # fmt: skip


@pytest.mark.parametrize(
    ("data", "stops"),
    [(data, True) for data in STOPPING] + [(data, False) for data in NOT_STOPPING],
)
def test_no_lost_byte_swallows_a_stop(library, data, stops):
    """A stop command works after any damaged bytes; without a stop, the run goes on."""
    duties = []
    for core in _both(library):
        core.receive(encode(Start(wave=Wave.SQUARE, frequency=1e-3, amplitude=70)))
        core.tick((0, 0), stamp=0, now=0)
        core.receive(data)
        duties.append(core.tick((0, 0), stamp=600_000, now=600_000))
    assert duties == [0 if stops else 70] * 2


def test_the_clock_may_overflow(library):
    """A run and the watchdog continue when the 32-bit counter of milliseconds overflows."""
    core, _ = _both(library)
    core.receive(b"k;" + encode(Start(wave=Wave.SQUARE, frequency=0.1, amplitude=50)))
    turn = 2**32
    for ms in range(0, 6000, 50):
        core.receive(b"k;")
        duty = core.tick((0, 0), stamp=(turn - 3000 + ms) % turn, now=(turn - 3000 + ms) % turn)
        assert duty == (50 if ms >= 5000 else 0)
        reading = parse_reading(core.take())
        assert reading is not None
        assert reading.ms == ms


def test_a_host_that_does_not_read_loses_only_whole_lines(library):
    """If the host does not read, the firmware drops whole lines and never part of one."""
    core, _ = _both(library)
    core.receive(encode(Start(wave=Wave.SINE, frequency=1.0, amplitude=4000, cycles=9)))
    for stamp in range(500):
        core.tick((-12345, 12345), stamp=stamp, now=stamp)
    sent = core.take()
    readings = [parse_reading(line) for line in sent.splitlines()]
    assert sent.endswith(b"\n")
    assert 200 < len(sent) < 256  # the ring buffer has 256 bytes, and one line may not fit
    assert [reading.ms for reading in readings if reading] == list(range(len(readings)))


def test_the_answer_to_a_query_is_a_description(library):
    """The firmware answers the query `?` with the description that it was built with."""
    core, _ = _both(library)
    core.receive(b"?;")
    assert parse_description(core.take()) == _description()


@pytest.mark.slow
@pytest.mark.sample
def test_noise_breaks_nothing(tmp_path):
    """Half a million ticks of noise, extreme gains and jumping clocks corrupt no memory."""
    sanitize = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n", encoding="utf-8")
    try:
        compile_c(tmp_path / "probe", *sanitize, probe)
    except AssertionError:
        pytest.skip("the C compiler has no sanitizers")
    program = compile_c(tmp_path / "fuzz", *sanitize, FIRMWARE / "host" / "fuzz.c", *SOURCES, "-lm")
    for seed in (1, 2):
        done = subprocess.run([program, str(seed), "250000"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


# Declarations of the functions that the sketch needs from a 32-bit board and from Teensy's
# additions to Arduino.
ARDUINO = """
#include <stdint.h>
#include <stdlib.h>
enum { OUTPUT, INPUT_PULLUP, CHANGE };
static inline int min(int a, int b) { return a < b ? a : b; }
void pinMode(uint8_t, uint8_t), digitalWrite(uint8_t, uint8_t), analogWrite(uint8_t, int);
void analogWriteResolution(uint32_t), analogWriteFrequency(uint8_t, float);
uint8_t digitalRead(uint8_t);
int digitalPinToInterrupt(uint8_t);
void attachInterrupt(uint8_t, void (*)(), int), noInterrupts(), interrupts();
uint32_t micros();
struct Line { void begin(long); int available(), read(), availableForWrite(), write(uint8_t); };
extern Line Serial;
"""


@pytest.mark.parametrize("options", [[], ["-DTEENSYDUINO"], ["-DMOTOR_DAC=40"]])
def test_the_sketch_compiles_for_other_boards(tmp_path, options):
    """The parts of the sketch for boards that are not simulated compile without a warning."""
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler is here")
    (tmp_path / "Arduino.h").write_text(ARDUINO, encoding="utf-8")
    command = [
        compiler, "-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", *options,
        "-I", tmp_path, "-I", FIRMWARE / "core", "-include", "Arduino.h",
        "-x", "c++", FIRMWARE / "cartlab_bench" / "cartlab_bench.ino",
    ]  # fmt: skip
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# ------------------------------------------------------------------- the parts


@given(
    size=st.floats(1e-13, 1e9) | st.just(0.0),
    sign=st.sampled_from(["", "-", "+"]),
    form=st.sampled_from([".9g", ".8e"]),
)
def test_numbers_are_read_as_python_reads_them(library, size, sign, form):
    """Numbers of nine digits, as the host sends them, are read as exactly the same floats.

    Longer ones are read as precisely as a float can hold them; words and infinities are refused.
    """
    text, read = sign + format(size, form), ctypes.c_double()
    assert library.read_number(text.encode(), False, ctypes.byref(read))
    assert read.value == float(text)
    for text in (
        "12345678901234567890123",
        "0.1234567890123456789012",
        "98765432109876543210.5e-3",
    ):
        assert library.read_number(text.encode(), False, ctypes.byref(read))
        assert read.value == pytest.approx(float(text), rel=1e-15)
    for text in ("", "+", ".", "e5", "1e", "1e+", "--1", "1.2.3", "0x10", "inf", "nan", "1_0",
                 "1 ", "1e999"):  # fmt: skip
        assert not library.read_number(text.encode(), False, ctypes.byref(read))


@given(value=st.integers(-(2**31), 2**31 - 1))
def test_integers_are_written_as_python_writes_them(library, value):
    """Every 32-bit integer is written as Python writes it."""
    text = ctypes.create_string_buffer(12)
    length = library.write_integer(text, value)
    assert text.raw[:length] == str(value).encode()


class _Quadrature(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int32),
        ("missed", ctypes.c_uint16),
        ("state", ctypes.c_uint8),
    )


RING = (0b00, 0b10, 0b11, 0b01)  # states of channels A and B, in the order of forward steps


@given(steps=st.lists(st.integers(-1, 1), max_size=60))
def test_every_edge_of_an_encoder_counts(library, steps):
    """An encoder's count is the number of forward edges minus the number of backward edges."""
    encoder, at = _Quadrature(), 0
    for step in steps:
        at += step
        library.quadrature_update(ctypes.byref(encoder), RING[at % 4])
    assert (encoder.count, encoder.missed) == (sum(steps), 0)


@pytest.mark.parametrize("at", range(4))
def test_an_impossible_transition_counts_as_missed(library, at):
    """If both channels change at once, one missed transition is noted, and counting goes on."""
    encoder = _Quadrature(state=RING[at])
    for state in (RING[(at + 2) % 4], RING[(at + 3) % 4]):
        library.quadrature_update(ctypes.byref(encoder), state)
    assert (encoder.count, encoder.missed) == (1, 1)
