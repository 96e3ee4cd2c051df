"""Messages between host and bench arrive unchanged, and noise is not taken for a message."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pipeline.protocol import (
    STOCK_STOP,
    ChirpEnd,
    Command,
    Description,
    Hands,
    PidGains,
    Reading,
    Signal,
    Start,
    StateGains,
    Tone,
    Wave,
    encode,
    format_description,
    format_reading,
    parse_description,
    parse_reading,
)
from pipeline.simulated.controller import CommandReader

ENCODERS = 2
# Nine significant digits are sent.
numbers = st.floats(-1e9, 1e9).map(lambda x: float(f"{x:.9g}"))
frequencies = st.floats(1e-3, 1e3).map(lambda x: float(f"{x:.9g}"))
starts = st.builds(
    Start,
    wave=st.sampled_from(Wave),
    encoder=st.sampled_from([None, 1, 2]),
    frequency=frequencies,
    amplitude=st.integers(-1_000_000, 1_000_000),
    cycles=st.integers(1, 1_000_000),
)
commands = st.one_of(
    starts,
    st.builds(PidGains, kp=numbers, ki=numbers, kd=numbers),
    st.builds(StateGains, gains=st.tuples(*[numbers] * 4), prefilter=numbers),
    st.builds(ChirpEnd, frequency=frequencies),
    st.builds(
        Tone,
        harmonic=st.integers(0, 10_000),
        share=st.floats(-1, 1).map(lambda x: float(f"{x:.9g}")),
        phase=st.floats(-10, 10).map(lambda x: float(f"{x:.9g}")),
    ),
    st.builds(Hands, held=st.sampled_from([(), (1,), (2,), (1, 2)]), released=st.integers(0, 2)),
    st.sampled_from(Signal),
)
noise = st.one_of(st.binary(max_size=3), st.text("dfghkmcqsotz;?19.-", max_size=4).map(str.encode))


def read(data: bytes, **options) -> list[Command]:
    return CommandReader(encoders=ENCODERS, **options).feed(data)


@given(st.lists(commands, max_size=6), st.integers(1, 7))
def test_commands_are_read_as_sent(sent, chunk):
    """Every encoded command is read back, in order, however the bytes are cut into pieces."""
    data = b"".join(map(encode, sent))
    reader = CommandReader(encoders=ENCODERS)
    got = []
    for at in range(0, len(data), chunk):
        got += reader.feed(data[at : at + chunk])
    assert got == sent
    assert reader.rejected == 0


@st.composite
def garbled(draw):
    """Draw a few commands in which bytes are lost, changed or inserted."""
    data = b"".join(map(encode, draw(st.lists(commands, min_size=1, max_size=3))))
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(data)))
        data = data[:at] + draw(noise) + data[at + draw(st.integers(0, 4)) :]
    return data


@given(garbled())
@example(b"d;q;o;o;1;10")
@example(b"d;")
@example(b"d;q")
@example(b"d")
@example(b"g;0;0;0;d")
@example(b"0" * 40)
def test_nothing_swallows_a_stop_or_a_reset(data):
    """After any noise, a bench still obeys the last stop or reset that was sent."""
    assert read(data + b"z;")[-1] is Signal.RESET
    assert read(data + encode(Signal.STOP))[-1] is Signal.STOP
    # A lone stop may look like the wave of a truncated start, until the next heartbeat.
    heard = read(data + b"s;k;")
    last_start = max((i for i, c in enumerate(heard) if isinstance(c, Start)), default=-1)
    assert Signal.STOP in heard[last_start + 1 :]


@given(garbled())
def test_a_bench_without_extensions_always_obeys_a_stop(data):
    """A stock bench obeys a stop, whatever came before."""
    stock = read(data + b"".join(map(encode, STOCK_STOP)), extensions=())
    assert stock[-1] is Signal.RESET


@pytest.mark.parametrize(
    "data",
    [
        b"d;q;o;o;0;100;1;",  # no frequency
        b"d;q;o;o;nan;100;1;",
        b"d;q;o;o;inf;100;1;",
        b"d;q;o;o;1e4;100;1;",
        b"d;q;o;o;1;1_000;1;",
        b"d;q;o;o;1;1.5;1;",
        b"d;q;o;o;1;1000001;1;",
        b"d;q;o;o;1;100;0;",
        b"d;x;o;o;1;100;1;",
        b"g;1;2;1e10;",
        b"h;4;0;",  # the bench has two carts
        b"h;1;3;",
        b"f;1;2;3;4;",  # one field too few, and no more comes
        b"x;;0;",
        b"d;q;o;o;0.00000000000000000000000000000001;100;1;",  # too long
    ],
)
def test_a_malformed_command_does_nothing(data):
    """Fields that are missing, out of range or of the wrong kind start nothing."""
    assert read(data) == []


counts = st.integers(-(10**10) + 1, 10**10 - 1)
readings = st.builds(
    Reading,
    counts=st.one_of(st.tuples(counts, counts), st.tuples(counts, counts, counts)),
    target=counts,
    duty=counts,
    ms=st.integers(0, 10**10 - 1),
)


def test_a_stock_bench_knows_three_commands():
    """A stock bench ignores the extensions' letters and fields, and knows no chirp."""
    data = b"?;s;k;f;1;2;3;4;5;c;20;h;1;0;d;c;o;o;1;100;1;"
    assert read(data, extensions=()) == []
    known = [Start(wave=Wave.SINE, frequency=1.0, amplitude=5), PidGains(kp=1, ki=0, kd=0)]
    assert read(b"".join(map(encode, known)), extensions=()) == known


@given(readings)
def test_lines_are_read_as_sent(reading):
    """A line is read as the reading that was written, with or without its line end."""
    line = format_reading(reading)
    assert parse_reading(line) == parse_reading(line.rstrip()) == reading


@given(readings, readings, st.integers(0, 255), st.data())
def test_spoilt_lines_are_not_readings(first, second, byte, data):
    """Two merged lines, or a line with a byte that no reading contains, are not read."""
    merged = format_reading(first)[:-1] + format_reading(second)
    assert parse_reading(merged) is None
    line = format_reading(first)
    at = data.draw(st.integers(0, len(line) - 2))
    spoiled = line[:at] + bytes([byte]) + line[at + 1 :]
    if chr(byte) not in "0123456789-:\r\n":
        assert parse_reading(spoiled) is None


descriptions = st.builds(
    Description,
    name=st.from_regex(r"[A-Za-z0-9_.-]+", fullmatch=True),
    encoders=st.sampled_from([2, 3]),
    carts=st.integers(1, 3),
    period=st.floats(1e-4, 1.0),
    baud=st.integers(300, 10**7),
    commands=st.frozensets(st.sampled_from("cfhkms")),
    input_unit=st.sampled_from(["V", "N", "count"]),
    input_per_count=st.floats(1e-9, 1e9),
    position_unit=st.sampled_from(["cm", "mm", "m", "in", "count"]),
    position_per_count=st.floats(-1e3, -1e-9) | st.floats(1e-9, 1e3),
)


@given(descriptions)
def test_descriptions_are_read_as_sent(bench):
    """A bench's answer to a query is read as the description that was written.

    Entries added in later versions are ignored.
    """
    line = format_description(bench)
    assert parse_description(line) == bench
    assert parse_description(line.rstrip() + b" colour=red\n") == bench
