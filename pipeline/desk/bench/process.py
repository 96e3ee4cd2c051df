"""The process in which the desk acquires: whatever the desk does, the bench is told to stop.

A line of JSON on stdin says what to record; any other line, or the end of the lines because the
desk is gone, is the Stop button. On stdout a line with the address of the live page, then one with
how it ended.
"""

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from pipeline.bench.host.acquire import acquire
from pipeline.bench.live.page import LivePage
from pipeline.errors import PipelineError


def main() -> None:
    """Acquire, and tell."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer

    def say(**line: Any) -> None:
        answers.write(json.dumps(line).encode() + b"\n")
        answers.flush()

    given = json.loads(sys.stdin.buffer.readline())
    try:
        with LivePage(Path(given["folder"])) as page:
            threading.Thread(target=_stop_on_word, args=(page,), daemon=True).start()
            say(url=page.url)
            outcomes = acquire(
                Path(given["folder"]),
                port=given["port"],
                observers=[page],
                only=given["only"],
                buttons=page.buttons,
            )
    except KeyboardInterrupt:
        say(over="Stopped. Begin again to go on where this ended.")
    except (PipelineError, OSError) as error:
        say(over=str(error))
    else:
        whole = {outcome.recording.id for outcome in outcomes if not outcome.partial}
        left = sorted({outcome.recording.id for outcome in outcomes} - whole)
        told = [f"{len(whole)} recorded", *([f"not recorded: {', '.join(left)}"] if left else [])]
        say(over="; ".join(told))


def _stop_on_word(page: LivePage) -> None:
    sys.stdin.buffer.readline()
    page.press("stop", turn=page.buttons.turn)


if __name__ == "__main__":
    main()
