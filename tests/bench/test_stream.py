"""From chunks of bytes to lines: which lines are kept, and which are counted as lost."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.bench.events import Anomalies
from pipeline.bench.stamps import fit_stamps
from pipeline.bench.stream import Stream
from pipeline.protocol import Reading, format_reading


def clock(n: int, *, period: float, phase: float = 0.3) -> np.ndarray:
    """Return the stamps (n,) of an uneven clock, in whole ms."""
    return np.floor(period * np.arange(n) + phase).astype(np.int64)


def lines(n: int, *, period: float = 1.0024, duty: int = 300) -> list[Reading]:
    """Return the lines of a dwell: two carts swing, the motor drives."""
    stamps = clock(n, period=period)
    wave = np.sin(2 * np.pi * 3.0 * 1e-3 * stamps)
    return [
        Reading(
            counts=(round(400 * s), round(-250 * s)),
            target=round(duty * s),
            duty=round(duty * s),
            ms=int(ms),
        )
        for s, ms in zip(wave, stamps, strict=True)
    ]


def read(raw: bytes, *, lump: int = 97, **options) -> tuple[list[Reading], Stream]:
    """Feed bytes in chunks, each as it would arrive at 115200 baud."""
    stream = Stream(encoders=2, free=(1, 2), **options)
    got = []
    for start in range(0, len(raw), lump):
        got += stream.feed(raw[start : start + lump], since=start / 20_000, now=start / 20_000)
    return got + stream.finish(), stream


def join(readings) -> bytes:
    """Return the bytes of these lines."""
    return b"".join(map(format_reading, readings))


@given(lump=st.integers(1, 400))
def test_chunks_of_any_size_give_the_same_lines(lump):
    """However the bytes are cut into chunks, every line comes out once, in order."""
    sent = lines(60)
    got, stream = read(join(sent), lump=lump)
    assert got == sent
    assert stream.anomalies(stream.fit()) == Anomalies()


@given(raw=st.binary(max_size=400), lump=st.integers(1, 50))
def test_noise_is_never_an_error(raw, lump):
    """Any bytes are read without an exception, and the stamps of the lines never decrease."""
    got, stream = read(raw, lump=lump)
    stamps = [reading.ms for reading in got]
    assert stamps == sorted(stamps)
    assert str(stream.anomalies())


@pytest.mark.parametrize("share", [0.002, 0.01, 0.04])
@pytest.mark.parametrize("period", [1.0, 1.0024, 2.08])
def test_lost_lines_are_distinguished_from_skips_of_the_clock(period, share):
    """If lines are lost at random, their number is found although the clock skips too."""
    rng = np.random.default_rng(7)
    stamps = clock(20_000, period=period)
    kept = rng.random(stamps.size) > share
    kept[[0, -1]] = True
    fit = fit_stamps(stamps[kept], period=1.0)
    # A loss at a skip of the clock, or beside it, may count as a skip, and a skip as a loss.
    assert abs(fit.missing - np.count_nonzero(~kept)) <= 2
    assert fit.period == pytest.approx(period, abs=2e-4)


def test_every_fault_is_counted_and_every_valid_line_kept():
    """With lost, noisy and merged lines together, whole lines are kept and faults counted."""
    rng = np.random.default_rng(3)
    sent = lines(20_000)
    kind = rng.choice(["whole", "drop", "garble", "merge"], size=20_000, p=[0.97] + 3 * [0.01])
    kind[[0, 1, -2, -1]] = "whole"
    kind[1:][kind[:-1] == "merge"] = "whole"  # a merged line damages the next one already
    raw, whole = bytearray(), []
    for reading, what, before in zip(sent, kind, ["", *kind[:-1]], strict=True):
        line = format_reading(reading)
        if what == "garble":
            line = line[:3] + b"#" + line[4:]
        if what != "drop":
            raw += line[:-1] if what == "merge" else line
        if what == "whole" and before != "merge":
            whole.append(reading)
    got, stream = read(bytes(raw), lump=300)
    assert got == whole
    anomalies = stream.anomalies(stream.fit())
    so_far = stream.anomalies().lost  # the count during the run errs by a few per second
    assert abs(so_far - anomalies.lost) <= 3 * 20
    assert anomalies.garbled == np.count_nonzero((kind == "garble") | (kind == "merge"))
    assert abs(anomalies.lost - np.count_nonzero(kind == "drop")) <= 2
    assert stream.fit().period == pytest.approx(1.0024, abs=1e-4)


@pytest.mark.parametrize("period", [1.0, 1.0004, 1.0024, 1.017, 5.003])
def test_no_line_of_a_whole_stream_counts_as_lost(period):
    """During a run the skips of an uneven clock are not counted as lost lines."""
    stream = Stream(encoders=2, period=round(period))
    for i in range(10_000):
        reading = Reading(counts=(0, 0), target=0, duty=0, ms=round(i * period))
        stream.feed(format_reading(reading), since=0.0, now=1e-3 * reading.ms)
        assert stream.anomalies().lost == 0


@pytest.mark.parametrize(
    ("change", "where"),
    [(lambda line: line[:-1] + b"9\n", "ahead"), (lambda line: line[:-2] + b"\n", "behind"),
     (lambda line: b"77" + line, "count")],
)  # fmt: skip
def test_a_line_with_an_impossible_number_is_garbled(change, where):
    """A line with a digit too many or too few can be parsed, but counts as garbled."""
    sent = lines(200)
    texts = [format_reading(reading) for reading in sent]
    texts[120] = change(texts[120])
    got, stream = read(b"".join(texts))
    assert got == sent[:120] + sent[121:], where
    assert stream.anomalies().garbled == 1
    assert stream.anomalies(stream.fit()).lost == 0


def test_lines_of_another_run_do_not_belong_to_this_one():
    """Neither the end of the previous run nor lines after a restart are taken for lines of the run.

    If stamps start again at zero, a reset is counted. A cart that reverses within one line at an
    end stop is no fault.
    """
    sent = lines(100)
    got, _ = read(b"5:0:0\n" + format_reading(lines(9000)[-1]) + join(sent))
    assert got == sent
    sent = lines(500)
    got, stream = read(join(sent) + join(lines(300)))
    assert got == sent
    assert "restarted" in stream.broken
    assert stream.anomalies().resets == 1
    out = [*range(0, 600, 12), *range(600, 0, -12)]
    sent = [Reading(counts=(x, 0), target=0, duty=0, ms=i) for i, x in enumerate(out)]
    got, stream = read(join(sent))
    assert (got, stream.anomalies().garbled) == (sent, 0)


@pytest.mark.parametrize("closed", [True, False])
def test_a_duty_in_only_one_line_is_accepted_in_closed_loop(closed):
    """A line whose duty differs from its neighbours' is accepted only in a closed loop.

    In a closed loop a flickering encoder can cause it.
    """
    sent = lines(100, period=1.0)
    sent[50] = Reading(counts=sent[50].counts, target=0, duty=120, ms=sent[50].ms)
    sent[49:52:2] = [
        Reading(counts=r.counts, target=0, duty=0, ms=r.ms) for r in (sent[49], sent[51])
    ]
    got, _ = read(join(sent), closed=closed)
    assert (sent[50] in got) == closed


def test_late_lines_are_counted_and_kept():
    """Lines held back for up to 60 ms are kept, and those over 20 ms late are counted."""
    sent = lines(1000, period=1.0)
    stream = Stream(encoders=2)
    got = []
    for reading in sent:
        arrival = max(reading.ms, 560) if 500 <= reading.ms < 560 else reading.ms
        got += stream.feed(format_reading(reading), since=1e-3 * arrival, now=1e-3 * arrival)
    assert got + stream.finish() == sent
    assert stream.anomalies().late in (
        40,
        41,
    )  # stamps 500 to 539; rounding decides on 540


def test_a_busy_host_makes_no_line_late():
    """Lines that waited because the host was busy do not count as late.

    Lateness is measured from the last time that the host found the port empty.
    """
    sent = lines(1000, period=1.0)
    stream = Stream(encoders=2)
    for start in range(0, 1000, 100):  # the host reads every 100 ms
        stream.feed(join(sent[start : start + 100]), since=1e-3 * start, now=1e-3 * (start + 100))
    assert stream.anomalies().late == 0


@pytest.mark.parametrize("since", [0, 2500])
def test_an_encoder_that_stands_still_is_noticed(since):
    """An encoder that stops, or never moves, while the motor drives is reported as stuck."""
    sent = [
        replace(r, counts=(r.counts[0], r.counts[1] if r.ms < since else 77)) for r in lines(6000)
    ]
    _, stream = read(join(sent))
    assert stream.anomalies().stuck == 1


def test_a_cart_that_rests_after_a_step_is_not_stuck():
    """A cart that comes to rest under a constant input does not count as a stuck encoder."""
    sent = [
        Reading(counts=(min(i, 300), 0), target=200, duty=200, ms=i) for i in range(4000)
    ]  # fmt: skip
    stream = Stream(encoders=2, free=(1,))
    stream.feed(join(sent), since=0.0, now=4.0)
    assert stream.anomalies().stuck == 0
