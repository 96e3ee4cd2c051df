"""Call a function in a second process, which loads its module while the first still computes."""

import os
import pickle
import signal
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from types import TracebackType
from typing import IO, Any, Literal

from pipeline.startup import collect_seldom, with_one_thread
from pipeline.words.progress import Progress


class SecondProcess:
    """A process for one call of a function; it is killed at the end of the `with` block.

    If the module is loaded here already, there is no second process: it would load it again.

    Parameters
    ----------
    module, function : names of the function, which writes no files. The process loads its module
        at once.
    """

    def __init__(self, module: str, function: str) -> None:
        self._module, self._function = module, function
        self._process: subprocess.Popen[bytes] | None = None
        if module in sys.modules:
            return
        pipe, none = subprocess.PIPE, subprocess.DEVNULL
        command = [sys.executable, "-P", "-m", __name__, module, function]
        with suppress(OSError):  # the computer cannot start another process
            self._process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, stderr=none, env=with_one_thread()
            )

    def __enter__(self) -> "SecondProcess":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> Literal[False]:
        if self._process:
            self._process.kill()
            self._process.communicate()
        return False

    def do(self, *args: Any, progress: Progress, **named: Any) -> Any:
        """Call the function with these arguments and return its answer.

        If the second process fails for any reason, this process does the work.
        """
        try:
            answers = self._send((args, named))
            while isinstance(stage := pickle.load(answers), str):
                progress(stage)
        except (OSError, EOFError, pickle.PickleError):
            work = getattr(import_module(self._module), self._function)
            return work(*args, progress=progress, **named)
        (answer,) = stage
        return answer

    def _send(self, task: object) -> IO[bytes]:
        """Send the task and return the stream of the answers.

        Raises
        ------
        OSError : the process has ended or never started.
        """
        if self._process is None:
            raise OSError("there is no second process")
        assert self._process.stdin
        assert self._process.stdout
        pickle.dump(task, self._process.stdin)
        self._process.stdin.flush()
        return self._process.stdout


def serve(module: str, function: str) -> None:
    """Load a function, then call it once: a stage is sent as text, the answer as a tuple."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the parent, which ends this
    collect_seldom()
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # libraries may print

    def send(answer: object) -> None:
        pickle.dump(answer, answers)
        answers.flush()

    work = getattr(import_module(module), function)
    args, named = pickle.load(sys.stdin.buffer)
    send((work(*args, progress=send, **named),))


if __name__ == "__main__":
    serve(*sys.argv[1:])
