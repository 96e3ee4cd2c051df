"""The process in which the desk acquires; it stops the bench even if the desk ends.

The first line of JSON on stdin says what to record or explore. Each further line is a pressed
button. If stdin ends, the desk is gone; this counts as Stop. Stdout gets one line for every event
of the session, then one line with its outcome.
"""

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.bench.acquire import acquire
from pipeline.bench.live_state import FRAME, LiveState
from pipeline.errors import PipelineError
from pipeline.processes import lines_sent, reserve_stdout


def main() -> None:
    """Acquire or explore as stdin says, and write the events to stdout."""
    say = reserve_stdout()
    sent = lines_sent()
    request = json.loads(next(sent))
    folder = Path(request["folder"])
    state, is_over = LiveState(folder), threading.Event()
    threading.Thread(target=_press_buttons, args=(sent, state), daemon=True).start()
    writer = threading.Thread(target=_write_events, args=(state, say, is_over))
    writer.start()
    end: dict[str, Any] = {}
    try:
        work = _explore if any(request["explore"]) else _acquire
        end = {"over": work(folder, request, state)}
    except KeyboardInterrupt:
        end = {"over": "Stopped. Start again to continue."}
    except (PipelineError, OSError) as error:
        end = {"over": str(error), "failed": True}
    finally:
        state.end()
        is_over.set()
        writer.join()
    say(**end)


def _acquire(folder: Path, request: dict[str, Any], state: LiveState) -> str:
    """Acquire recordings; return a sentence on what was recorded."""
    outcomes = acquire(
        folder, port=request["port"], observer=state, only=request["only"], buttons=state.buttons
    )
    whole = {outcome.recording.id for outcome in outcomes if not outcome.partial}
    left = sorted({outcome.recording.id for outcome in outcomes} - whole)
    parts = [f"{len(whole)} recorded", *([f"not recorded: {', '.join(left)}"] if left else [])]
    return "; ".join(parts)


def _explore(folder: Path, request: dict[str, Any], state: LiveState) -> str:
    """Explore; return a sentence on what is known at the end."""
    from pipeline.bench.acquire import explore_bench
    from pipeline.experiments.information import read_error_goal, read_time
    from pipeline.report.exploration import write_diary
    from pipeline.words.text import with_symbols

    until, limit = request["explore"]
    turns = explore_bench(
        folder,
        port=request["port"],
        observer=state,
        buttons=state.buttons,
        goal=read_error_goal(until),
        write_diary=write_diary,
        seconds=read_time(limit),
    )
    reached = "The goal is reached" if turns[-1].reached else "The goal was not reached"
    return f"{reached}: {with_symbols(turns[-1].summary)}."


def _write_events(state: LiveState, say: Callable[..., None], is_over: threading.Event) -> None:
    """Write the state of the session whenever it changes; nothing if the session never began.

    Parameters
    ----------
    is_over : set when the session has ended.
    """
    begun = last = False
    for events in state.follow(version=1):
        for kind, data in events:
            begun = begun or data.get("phase") != "over"
            if begun:
                say(**{kind: data})
        if last:
            return
        last = is_over.wait(FRAME)


def _press_buttons(sent: Iterator[bytes], state: LiveState) -> None:
    for line in sent:
        state.apply(**json.loads(line))
    state.press("stop", turn=0)


if __name__ == "__main__":
    main()
