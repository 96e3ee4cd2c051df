"""Show a session at the bench in the terminal; print little if stderr is not a terminal."""

import sys
import time
from collections import deque
from collections.abc import Sequence
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pipeline.bench.events import Anomalies, RunOutcome
from pipeline.errors import ConfigError
from pipeline.experiments.plan import Plan, Recording, session_time, time_words
from pipeline.protocol import Reading

_BARS = "▁▂▃▄▅▆▇█"


class Terminal:
    """An observer that shows the plan, the run and the positions in the terminal.

    Parameters
    ----------
    yes : whether everything that a person is asked to do counts as done.
    """

    def __init__(self, *, yes: bool = False, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._yes = yes
        self._view = _View()
        self._live = Live(
            get_renderable=self._view.render,
            console=self._console,
            refresh_per_second=8.0,
            transient=True,
        )

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Show what will be recorded."""
        self._view.plan = plan.recordings
        self._view.done = set(done)

    def confirm(self, instruction: str) -> None:
        """Ask the person at the keyboard, and wait.

        Raises
        ------
        ConfigError : nobody is at the keyboard.
        """
        if self._yes:
            self.remark(f"{instruction}: confirmed by --yes, continuing")
            return
        if not sys.stdin.isatty():
            raise ConfigError(
                f"{instruction}: nobody is at the keyboard to confirm it; with --yes it counts as "
                "done"
            )
        self._ask(instruction, keys="then press Enter")

    def settling(self, recording: Recording, seconds: float) -> None:
        """Show that the carts must come to rest."""
        self._view.begin(recording, f"coming to rest, {seconds:g} s")

    def started(self, recording: Recording) -> None:
        """Show the run."""
        self._view.begin(recording, "")

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Show the newest lines."""
        self._view.take(batch, anomalies)

    def finished(self, outcome: RunOutcome) -> None:
        """Print how the run ended, in a line that stays."""
        self._view.recording = None
        name = outcome.recording.id
        if not outcome.partial:
            self._view.done.add(name)
        if outcome.partial or outcome.remarks or self._console.is_terminal:
            end = outcome.partial or f"{outcome.lines} lines"
            self.remark("; ".join([f"{name}: {end}", *outcome.remarks]))

    def remark(self, sentence: str) -> None:
        """Print a sentence."""
        self._console.print(Text(sentence), soft_wrap=True)

    def _ask(self, question: str, *, keys: str) -> str:
        """Ask a question and return the typed answer.

        Parameters
        ----------
        keys : text that names the keys to choose from.

        Raises
        ------
        ConfigError : the keyboard is closed.
        """
        self._live.stop()
        self._console.print(Text(f"{question}, {keys} (Ctrl-C ends)"), end=" ")
        try:
            _forget_keys()
            return input().strip()
        except EOFError:
            raise ConfigError(f"{question}: the keyboard was closed") from None
        finally:
            if self._console.is_terminal:
                self._live.start()

    def thinking(self, stage: str) -> None:
        """Show what is being computed."""
        self._view.thinking = stage

    def thought(self, sentence: str) -> None:
        """Print what is known and what comes next."""
        self._view.thinking = ""
        self.remark(sentence)

    def vetoes(self, recording: Recording) -> bool:
        """Ask whether to leave out a recording; return True if so.

        Raises
        ------
        ConfigError : the keyboard is closed.
        """
        return self._ask(f"Enter records {recording.id}", keys="v and Enter vetoes it") == "v"


class _View:
    """What the terminal shows at the moment."""

    def __init__(self) -> None:
        self.plan: tuple[Recording, ...] = ()
        self.done: set[str] = set()
        self.recording: Recording | None = None
        self.thinking = ""
        self._state = ""
        self._ms = 0
        self._anomalies = Anomalies()
        self._traces: list[deque[int]] = []
        self._arrived: deque[tuple[float, int]] = deque()

    def begin(self, recording: Recording, state: str) -> None:
        """Begin to show another run."""
        self.recording, self._state, self._ms = recording, state, 0
        self.thinking = ""
        self._anomalies = Anomalies()
        self._traces, self._arrived = [], deque()

    def take(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Add new lines; the last one of each batch is enough for the sparklines."""
        last, now = batch[-1], time.monotonic()
        self._ms, self._anomalies = last.ms, anomalies
        if len(self._traces) != len(last.counts):
            # Width of a sparkline in characters.
            self._traces = [deque(maxlen=60) for _ in last.counts]
        for trace, count in zip(self._traces, last.counts, strict=True):
            trace.append(count)
        self._arrived.append((now, len(batch)))
        while now - self._arrived[0][0] > 2.0:  # s
            self._arrived.popleft()

    def render(self) -> Group:
        """Return what to show."""
        left = [r for r in self.plan if r.id not in self.done]
        seconds = max(0.0, session_time(left) - 1e-3 * self._ms)
        head = Table.grid(padding=(0, 2))
        head.add_row(
            ProgressBar(total=max(1, len(self.plan)), completed=len(self.done), width=30),
            Text(f"{len(self.done)} of {len(self.plan)} recorded, {time_words(seconds)} left"),
        )
        return Group(head, *self._run_lines())

    def _run_lines(self) -> list[Text]:
        run = self.recording
        if run is None:
            return [Text(self.thinking)] if self.thinking else []
        state = self._state or (
            f"{1e-3 * self._ms:.1f} of {run.duration:.1f} s, {self._rate():.0f} lines/s, "
            f"line faults: {self._anomalies}"
        )
        lines = [Text(f"{run.id} ({run.kind}): {state}")]
        for number, trace in enumerate(self._traces, start=1):
            shown = list(trace)  # a copy, because another thread appends to it
            if shown:
                lines.append(Text(f"  encoder {number} {shown[-1]:>7}  {sparkline(shown)}"))
        return lines

    def _rate(self) -> float:
        arrived = list(self._arrived)  # a copy, because another thread appends to it
        if len(arrived) < 2 or arrived[-1][0] == arrived[0][0]:
            return 0.0
        return sum(n for _, n in arrived[1:]) / (arrived[-1][0] - arrived[0][0])


def _forget_keys() -> None:
    """Discard keys typed before the question, because an answer may start the motor."""
    try:
        import termios
    except ImportError:  # on Windows
        import msvcrt

        while msvcrt.kbhit():  # pyright: ignore[reportAttributeAccessIssue]
            msvcrt.getwch()  # pyright: ignore[reportAttributeAccessIssue]
    else:
        termios.tcflush(sys.stdin, termios.TCIFLUSH)


def sparkline(values: Sequence[int]) -> str:
    """Return values as a row of bars of different heights."""
    low, high = min(values), max(values)
    step = (high - low) / (len(_BARS) - 1) or 1.0
    return "".join(_BARS[round((value - low) / step)] for value in values)
