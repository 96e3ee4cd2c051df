"""Submissions with a plan to carry out, and an observer that notes each call."""

import subprocess
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Anomalies, RunOutcome
from pipeline.bench.orders import Order, make_order
from pipeline.experiments.gains import CountScales
from pipeline.experiments.plan import Plan, PlanLimits, Recording, save_plan
from pipeline.protocol import Description, Reading
from pipeline.submission import System, load_submission
from pipeline.submission.load import NAME
from tests.helpers.waiting import started, until

LIMITS = PlanLimits(input=0.5, travel=2.5)  # V and cm, the scales that the virtual benches state


# The cause of an early end, and the words that only the reason with this cause has.
CAUSES = {
    "idle motor": "although it should rest", "duty": "counts instead", "travel": "from its zero",
    "input": "the input was", "wave": "does not follow the wave", "end": "went on past the end",
    "unreadable": "cannot be read", "silent": "fell silent", "busy": "this computer was too busy",
    "line": "the line to the bench is gone", "restart": "the bench restarted",
    "clock": "clock hardly moves", "stamps": "time stamps jump", "still": "no free cart moved",
    "by hand": "by hand",
}  # fmt: skip


def causes(said: str) -> list[str]:
    """Return what the reason of an early end is about, as keys of `CAUSES`."""
    return [cause for cause, words in CAUSES.items() if words in said]


def decay(
    name: str, *, carts: Sequence[int] = (1,), seconds: float = 6.0, settle: float = 0.3
) -> Recording:
    """Return a decay whose first cart is released by hand."""
    return Recording(
        id=name, kind="decay", carts=tuple(carts), wave="delta", amplitude=0.0,
        frequency=1 / seconds, release=carts[0], settle=settle,
    )  # fmt: skip


def ordered(
    recording: Recording,
    bench: Description,
    *,
    limits: PlanLimits = LIMITS,
    per_count: float | None = None,
    position: float = 0.00227,
    carts: int = 2,
    **options: Any,
) -> Order:
    """Return the order for a recording on a bench with all springs."""
    scales = CountScales(input=per_count or bench.input_per_count, position=position)
    system = System(carts=carts, springs=(True,) * (carts + 1))
    return make_order(
        recording, limits=limits, scales=scales, system=system, bench=bench, **options
    )


def carried_out(
    work: Path, port: str, *only: str, notes: "Notes | None" = None
) -> tuple[RunOutcome, ...]:
    """Acquire these recordings; return their outcomes."""
    return acquire(work, port=port, observer=notes or Notes(), only=only or ["dwell"])


def sine(name: str, *, seconds: float, frequency: float = 2.0, settle: float = 0.0) -> Recording:
    """Return a dwell with both carts free, well within the limits."""
    return Recording(
        id=name, kind="sine", carts=(1, 2), wave="sine", amplitude=0.01, frequency=frequency,
        cycles=round(seconds * frequency), settle=settle,
    )  # fmt: skip


def write_work(
    folder: Path,
    recordings: Sequence[Recording],
    *,
    limits: PlanLimits = LIMITS,
    scales: str = "",
    per_count: float | None = None,
) -> Path:
    """Write a submission of two carts with this plan; scales not given come from the bench."""
    folder.mkdir(parents=True, exist_ok=True)
    unit = '"cm"' if per_count is None else f'"cm", per_count = {per_count}'
    text = f"version = 1\n\n[system]  # ours\ncarts = 2\nposition = {{ unit = {unit} }}\n{scales}"
    (folder / NAME).write_text(text, encoding="utf-8")
    save_plan(Plan(limits=limits, recordings=tuple(recordings)), load_submission(folder))
    return folder


class Notes:
    """An observer that notes every call and confirms everything."""

    def __init__(self) -> None:
        self.confirmed: list[str] = []
        self.remarks: list[str] = []
        self.outcomes: list[RunOutcome] = []
        self.readings_seen: list[Reading] = []
        self.plans: list[tuple[int, frozenset[str]]] = []

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Note the length of the plan and what is done."""
        self.plans.append((len(plan.recordings), done))

    def confirm(self, instruction: str) -> None:
        """Note the instruction and do it."""
        self.confirmed.append(instruction)

    def settling(self, recording: Recording, seconds: float) -> None:
        """Note nothing."""

    def started(self, recording: Recording) -> None:
        """Forget the lines of the previous run."""
        self.readings_seen = []

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines."""
        self.readings_seen += batch

    def finished(self, outcome: RunOutcome) -> None:
        """Note the outcome."""
        self.outcomes.append(outcome)

    def remark(self, sentence: str) -> None:
        """Note the sentence."""
        self.remarks.append(sentence)

    def thinking(self, stage: str) -> None:
        """Note nothing."""

    def thought(self, sentence: str) -> None:
        """Note the sentence."""
        self.remarks.append(sentence)


def host(folder: Path, port: str, *options: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """Run `cartlab acquire` in a process of its own while the block runs."""
    command = [sys.executable, "-m", "pipeline", "acquire", folder, "--port", port, *options]
    return started(command, stderr=subprocess.PIPE, encoding="utf-8")


def until_bytes(raw: Path, process: subprocess.Popen[str], *, least: int = 5_000) -> None:
    """Wait until a host has written this many bytes of a run."""

    def written() -> bool:
        assert process.poll() is None, "the host ended too early"
        return raw.exists() and raw.stat().st_size >= least

    until(written, "a run")
