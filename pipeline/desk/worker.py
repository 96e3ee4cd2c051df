"""The process in which the desk's work is done: files of strangers are read nowhere else.

A line of JSON a task on stdin; on stdout a line for every stage, then one with the answer.
"""

import faulthandler
import json
import os
import queue
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

from pipeline.desk.jobs import MEMORY
from pipeline.desk.tasks import TASKS
from pipeline.errors import PipelineError
from pipeline.garbage import collect_seldom
from pipeline.processes import limit_memory, lines_sent

_LONGEST = 300  # characters of what is said of a fault


def main() -> None:
    """Answer every task; end at once where nobody is there to be answered."""
    collect_seldom()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer
    faulthandler.enable()
    limit_memory(MEMORY)
    tasks: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()

    def say(**line: Any) -> None:
        answers.write(json.dumps(line).encode() + b"\n")
        answers.flush()

    while True:
        answer(tasks.get(), say)


def answer(task: bytes, say: Callable[..., None]) -> None:
    """Do a task and say the lines about it."""
    name, given = json.loads(task)
    try:
        say(done=TASKS[name](**given, progress=lambda stage: say(stage=stage)))
    except PipelineError as error:
        say(failed=str(error))
    except MemoryError:
        say(failed="needs more memory than allowed")
    except OSError as error:
        say(failed=f"{error.filename or ''}: {error.strerror or error}".lstrip(": "))
    except Exception as error:  # a fault of our own costs this task, not the process
        traceback.print_exc()
        what = f"{type(error).__name__}: {error}"[:_LONGEST]
        say(failed=f"cartlab itself failed ({what}); please report it")


def _listen(tasks: "queue.SimpleQueue[bytes]") -> None:
    for line in lines_sent():
        tasks.put(line)
    os._exit(0)  # whatever is under way: files are written whole or not at all


if __name__ == "__main__":
    main()
