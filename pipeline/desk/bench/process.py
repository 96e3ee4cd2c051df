"""The process in which the desk acquires: whatever the desk does, the bench is told to stop.

A line of JSON on stdin says what to record, or how far to explore; any other line, or the end of
the lines because the desk is gone, is the Stop button. On stdout a line with the address of the
live page, once it has something to show, then one with how it ended.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.bench.host.acquire import acquire
from pipeline.bench.live.page import LivePage
from pipeline.errors import PipelineError
from pipeline.processes import lines_sent

_LOOK = 0.05  # s between looks whether there is news


def main() -> None:
    """Acquire or explore, and tell."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer

    def say(**line: Any) -> None:
        answers.write(json.dumps(line).encode() + b"\n")
        answers.flush()

    sent = lines_sent()
    given = json.loads(next(sent))
    folder = Path(given["folder"])
    try:
        with LivePage(folder) as page:
            threading.Thread(target=_stop_on_word, args=(sent, page), daemon=True).start()
            threading.Thread(target=_say_where, args=(page, say), daemon=True).start()
            work = _explore if any(given["explore"]) else _acquire
            said = work(folder, given, page)
    except KeyboardInterrupt:
        say(over="Stopped. Begin again to go on where this ended.")
    except (PipelineError, OSError) as error:
        say(over=str(error), failed=True)
    else:
        say(over=said)


def _acquire(folder: Path, given: dict[str, Any], page: LivePage) -> str:
    """Return what was recorded."""
    outcomes = acquire(
        folder, port=given["port"], observers=[page], only=given["only"], buttons=page.buttons
    )
    whole = {outcome.recording.id for outcome in outcomes if not outcome.partial}
    left = sorted({outcome.recording.id for outcome in outcomes} - whole)
    told = [f"{len(whole)} recorded", *([f"not recorded: {', '.join(left)}"] if left else [])]
    return "; ".join(told)


def _explore(folder: Path, given: dict[str, Any], page: LivePage) -> str:
    """Return what is known at the end."""
    from pipeline.bench.explore.at_bench import explore_bench
    from pipeline.bench.explore.wish import read_time, read_wish
    from pipeline.report.words import with_symbols

    until, limit = given["explore"]
    turns = explore_bench(
        folder,
        port=given["port"],
        observers=[page],
        buttons=page.buttons,
        wish=read_wish(until),
        seconds=read_time(limit),
    )
    reached = "What you wanted is known" if turns[-1].reached else "Not all you wanted is known"
    return f"{reached}: {with_symbols(turns[-1].said)}."


def _say_where(page: LivePage, say: Callable[..., None]) -> None:
    """Tell the page's address with its first news: before, it may be that no bench is there."""
    while not page.version:
        time.sleep(_LOOK)
    if page.snapshot()["phase"] != "over":
        say(url=page.url)


def _stop_on_word(sent: Iterator[bytes], page: LivePage) -> None:
    next(sent, b"")
    page.press("stop", turn=page.buttons.turn)


if __name__ == "__main__":
    main()
