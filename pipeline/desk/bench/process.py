"""The process in which the desk acquires: whatever the desk does, the bench is told to stop.

A line of JSON on stdin says what to record, or how far to explore; each further one is a button
that somebody pressed. The end of the lines, because the desk is gone, is the Stop button. On stdout
a line for everything that is to be seen of the session, then one with how it ended.
"""

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.bench.host.acquire import acquire
from pipeline.bench.live.live_state import FRAME, LiveState
from pipeline.errors import PipelineError
from pipeline.processes import answering, lines_sent


def main() -> None:
    """Acquire or explore, and tell."""
    say = answering()
    sent = lines_sent()
    given = json.loads(next(sent))
    folder = Path(given["folder"])
    state, is_over = LiveState(folder), threading.Event()
    threading.Thread(target=_press_as_told, args=(sent, state), daemon=True).start()
    telling = threading.Thread(target=_tell_news, args=(state, say, is_over))
    telling.start()
    end: dict[str, Any] = {}
    try:
        work = _explore if any(given["explore"]) else _acquire
        end = {"over": work(folder, given, state)}
    except KeyboardInterrupt:
        end = {"over": "Stopped. Begin again to go on where this ended."}
    except (PipelineError, OSError) as error:
        end = {"over": str(error), "failed": True}
    finally:
        state.end()
        is_over.set()
        telling.join()
    say(**end)


def _acquire(folder: Path, given: dict[str, Any], state: LiveState) -> str:
    """Return what was recorded."""
    outcomes = acquire(
        folder, port=given["port"], observers=[state], only=given["only"], buttons=state.buttons
    )
    whole = {outcome.recording.id for outcome in outcomes if not outcome.partial}
    left = sorted({outcome.recording.id for outcome in outcomes} - whole)
    told = [f"{len(whole)} recorded", *([f"not recorded: {', '.join(left)}"] if left else [])]
    return "; ".join(told)


def _explore(folder: Path, given: dict[str, Any], state: LiveState) -> str:
    """Return what is known at the end."""
    from pipeline.experiments.exploring.at_bench import explore_bench
    from pipeline.experiments.exploring.error_goal import read_error_goal, read_time
    from pipeline.words.text import with_symbols

    until, limit = given["explore"]
    turns = explore_bench(
        folder,
        port=given["port"],
        observers=[state],
        buttons=state.buttons,
        goal=read_error_goal(until),
        seconds=read_time(limit),
    )
    reached = "What you wanted is known" if turns[-1].reached else "Not all you wanted is known"
    return f"{reached}: {with_symbols(turns[-1].said)}."


def _tell_news(state: LiveState, say: Callable[..., None], is_over: threading.Event) -> None:
    """Tell what there is to see as it changes; of a session that never began, nothing."""
    begun = last = False
    for news in state.follow(version=1):
        for kind, data in news:
            begun = begun or data.get("phase") != "over"
            if begun:
                say(**{kind: data})
        if last:
            return
        last = is_over.wait(FRAME)


def _press_as_told(sent: Iterator[bytes], state: LiveState) -> None:
    for line in sent:
        state.heed(**json.loads(line))
    state.press("stop", turn=0)


if __name__ == "__main__":
    main()
