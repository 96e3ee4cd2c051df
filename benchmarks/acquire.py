"""How reliable acquisition is: speed, faults, limits, and a killed host.

    python -m benchmarks.acquire [--minutes 10] [--faulty-seconds 30] [--stops 20] [--kills 100]

Each part talks to its own `cartlab emulate`. The number 0 skips a part.
"""

import argparse
import queue
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Anomalies
from pipeline.bench.experiments import readings_of
from pipeline.bench.raw import read_raw
from pipeline.errors import ConfigError
from pipeline.experiments.plan import PlanLimits
from pipeline.plant.chain import PRESETS
from pipeline.protocol import Reading
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.acquisitions import Notes, host, sine, write_work
from tests.helpers.benches import emulator

FAULTS = ("drop", "garble", "merge", "delay")


class _Once(Notes):
    """An observer that never repeats a recording and ignores all lines."""

    def confirm(self, instruction: str) -> None:
        """Refuse, as nobody can confirm the instruction."""
        raise ConfigError(instruction)

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Drop the readings."""


def stream(folder: Path, *, minutes: float) -> None:
    """Stream at 1 kHz; print the lost lines, and the processor time of host and emulator."""
    write_work(folder, [sine("long", seconds=60 * minutes)])
    with emulator() as bench:
        process = psutil.Process(bench.pid)
        notes, own = _Once(), psutil.Process()
        began, before, bench_before = time.monotonic(), own.cpu_times(), process.cpu_times()
        acquire(folder, port=bench.address, observer=notes, only=["long"])
        taken = time.monotonic() - began
        sent = bench.event("run")
        cpu = [
            sum(after[:2]) - sum(first[:2])
            for after, first in (
                (own.cpu_times(), before),
                (process.cpu_times(), bench_before),
            )
        ]
    outcome = notes.outcomes[-1]
    print(
        f"stream: {minutes:g} min, {sent['lines']} lines sent, {outcome.lines} kept, line faults: "
        f"{outcome.anomalies}, {outcome.partial or 'whole'}; host {cpu[0] / taken:.1%} of a core, "
        f"emulator {cpu[1] / taken:.1%}"
    )


def faults(folder: Path, *, seconds: float) -> None:
    """Damage 1 % of the lines by each kind of fault; check that the good lines are kept."""
    write_work(folder, [sine("faulty", seconds=seconds)])
    options = [option for kind in FAULTS for option in ("--fault", f"{kind}=0.01")]
    with emulator(*options) as bench:
        notes = Notes()
        acquire(folder, port=bench.address, observer=notes, only=["faulty"])
        while (sent := bench.event("run"))["ended"] != "done":
            pass
    struck, outcome = sent["injected"], notes.outcomes[-1]
    whole = sent["lines"] - struck["drop"] - struck["garble"] - 2 * struck["merge"]
    points = analyse(load_submission(folder)).sine_points
    true = np.abs(PRESETS["throne-2dof"].frequency_response(np.array([points[0].omega])))[:, 0]
    gains = ", ".join(
        f"{p.gain:.5g} ± {p.gain_std:.2g} cm/V (true {true[p.cart - 1]:.5g})" for p in points
    )
    print(
        f"faults: sent {sent['lines']}, struck {struck}; valid {whole}, kept {outcome.lines}; "
        f"counted {outcome.anomalies}; analysed: {gains}"
    )


def stops(folder: Path, *, n: int) -> None:
    """Pass the travel limit; print how many ms after the first line beyond it the bench stopped."""
    delays = []
    with emulator() as bench:
        for trial in range(n):
            work = folder / str(trial)
            limits = PlanLimits(input=0.5, travel=0.05 + 0.1 * trial / n)
            write_work(work, [sine("far", seconds=5.0, frequency=1.6)], limits=limits)
            acquire(work, port=bench.address, observer=_Once(), only=["far"])
            while (sent := bench.event("run"))["ended"] != "stopped":
                pass
            run = read_raw(work / "raw" / "far-1.raw")
            most = limits.travel / run.header.bench.position_per_count
            lines = readings_of(run)
            first = next(r for r in lines if max(map(abs, r.counts)) > most)
            delays.append(1.0024 * sent["lines"] - first.ms)
    late = np.array(delays)
    print(f"stops: {n}, ms to the stop: median {np.median(late):.1f}, worst {late.max():.1f}")


def kills(folder: Path, *, n: int) -> None:
    """Kill the host at random times; print how much the raw file lacks and when the motor stops."""
    rng, missing, off = np.random.default_rng(0), [], []
    with emulator() as bench:
        for trial in range(n):
            work = write_work(folder / str(trial), [sine("killed", seconds=60.0)])
            raw = work / "raw" / "killed-1.raw"
            with host(work, bench.address, "--only", "killed", "--yes") as process:
                while not raw.exists():
                    time.sleep(0.01)
                time.sleep(float(rng.uniform(0.05, 1.5)))
                process.kill()
            silent = bench.event("motor off")["ms_after_heartbeat"]
            sent = bench.event("run")["lines"]
            run = read_raw(raw)
            kept = readings_of(run)
            # The bench streams until its watchdog acts; the last heartbeat was up to 30 ms before
            # the kill.
            missing.append(1.0024 * sent - silent - (kept[-1].ms if kept else 0))
            off.append(silent)
            while not _is_quiet(bench):
                time.sleep(0.05)
    lack, silence = np.array(missing), np.array(off)
    print(
        f"kills: {n}, all raw files readable; at the last heartbeat they lacked at most "
        f"{max(0.0, lack.max()):.0f} ms; motor off {np.median(silence):.0f} ms after it, "
        f"worst {silence.max()} ms"
    )


def _is_quiet(bench) -> bool:
    try:
        bench.event("client", timeout=0.2)
    except queue.Empty:
        return True
    return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--faulty-seconds", type=float, default=30.0)
    parser.add_argument("--stops", type=int, default=20)
    parser.add_argument("--kills", type=int, default=100)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if asked.stops:
            stops(folder / "stops", n=asked.stops)
        if asked.faulty_seconds:
            faults(folder / "faults", seconds=asked.faulty_seconds)
        if asked.kills:
            kills(folder / "kills", n=asked.kills)
        if asked.minutes:
            stream(folder / "stream", minutes=asked.minutes)


if __name__ == "__main__":
    main()
