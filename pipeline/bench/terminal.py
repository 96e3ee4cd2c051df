"""Show a session at the bench in the terminal; print little if stderr is not a terminal."""

import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pipeline.bench.events import Anomalies, RunOutcome
from pipeline.bench.live_state import LiveState
from pipeline.errors import ConfigError
from pipeline.experiments.plan import Recording, time_words

_BARS = "▁▂▃▄▅▆▇█"
_SPAN = 600  # points in a sparkline, of which every tenth is shown


class Terminal(LiveState):
    """A session that is shown in the terminal.

    Parameters
    ----------
    folder : see `LiveState`.
    yes : whether everything that a person is asked to do counts as done.
    has_page : whether a person confirms on a page, unless `yes`.
    """

    def __init__(
        self,
        folder: Path,
        *,
        yes: bool = False,
        has_page: bool = False,
        console: Console | None = None,
    ) -> None:
        super().__init__(folder)
        self._console = console or Console(stderr=True)
        self._yes, self._has_page = yes, has_page
        # Times of the last views, and the lines of the run at these times.
        self._seen: deque[tuple[float, int]] = deque()
        self._live = Live(
            get_renderable=self._render,
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

    def say(self, sentence: str) -> None:
        """Print a sentence that no page shows."""
        self._console.print(Text(sentence), soft_wrap=True)

    # ------------------------------------------------------------- by the acquisition

    def confirm(self, instruction: str) -> None:
        """Ask the person at the keyboard or at the page, and wait.

        Raises
        ------
        ConfigError : nobody is there.
        """
        if self._yes:
            self.remark(f"{instruction}: confirmed by --yes, continuing")
        elif self._has_page:
            super().confirm(instruction)
        elif sys.stdin.isatty():
            self._ask(instruction, keys="then press Enter")
        else:
            raise ConfigError(
                f"{instruction}: nobody is at the keyboard to confirm it; with --yes it counts as "
                "done"
            )

    def finished(self, outcome: RunOutcome) -> None:
        """Print how the run ended, in a line that stays."""
        super().finished(outcome)
        if outcome.partial or outcome.remarks or self._console.is_terminal:
            end = outcome.partial or f"{outcome.lines} lines"
            self.say("; ".join([f"{outcome.recording.id}: {end}", *outcome.remarks]))

    def remark(self, sentence: str) -> None:
        """Print a sentence."""
        super().remark(sentence)
        self.say(sentence)

    def thought(self, sentence: str) -> None:
        """Print what is known and what comes next."""
        super().thought(sentence)
        self.say(sentence)

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

    def vetoes(self, recording: Recording) -> bool:
        """Ask whether to leave out a recording; return True if so.

        Raises
        ------
        ConfigError : the keyboard is closed.
        """
        return self._ask(f"Enter records {recording.id}", keys="v and Enter vetoes it") == "v"

    # ------------------------------------------------------------------ by the display

    def _render(self) -> Group:
        """Return what to show: the same state that a page shows."""
        state = self.snapshot()
        run = self.points(run=self._run, start=self._end - _SPAN)
        recorded = sum(entry["state"] == "done" for entry in state["plan"])
        recording = state["phase"] == "recording"
        t = run["points"][-1][0] if recording and run["points"] else 0.0
        head = Table.grid(padding=(0, 2))
        head.add_row(
            ProgressBar(total=max(1, len(state["plan"])), completed=recorded, width=30),
            Text(
                f"{recorded} of {len(state['plan'])} recorded, "
                f"{time_words(max(0.0, state['seconds_left'] - t))} left"
            ),
        )
        lines = [] if state["phase"] == "waiting" else [state["waits"]]
        if recording:
            counters = dict(run["counters"])
            rate = self._rate(counters.pop("lines"))
            lines = [
                f"{state['now']}: {t:.1f} of {state['duration']:.1f} s, {rate:.0f} lines/s, "
                f"line faults: {Anomalies(**counters)}"
            ]
            # Every tenth point, so that a bar belongs to the same time in each view.
            shown = [p for i, p in enumerate(run["points"], start=run["start"]) if i % 10 == 0]
            unit = state["units"]["position"]
            for cart, trace in enumerate(list(zip(*shown, strict=True))[3:], start=1):
                lines.append(f"  cart {cart} {trace[-1]:>9.4g} {unit}  {sparkline(trace)}")
        return Group(head, *map(Text, lines))

    def _rate(self, lines: int) -> float:
        """Return the lines per second during the last two seconds of a run."""
        now = time.monotonic()
        if self._seen and lines < self._seen[-1][1]:  # another run
            self._seen.clear()
        self._seen.append((now, lines))
        while now - self._seen[0][0] > 2.0:  # s
            self._seen.popleft()
        (since, before), (_, last) = self._seen[0], self._seen[-1]
        return (last - before) / (now - since) if now > since else 0.0


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


def sparkline(values: Sequence[float]) -> str:
    """Return values as a row of bars of different heights."""
    low, high = min(values), max(values)
    step = (high - low) / (len(_BARS) - 1) or 1.0
    return "".join(_BARS[round((value - low) / step)] for value in values)
