"""Call a function in a second process, which loads its module while the first still computes."""

import pickle
import sys
from base64 import b64decode, b64encode
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

from pipeline.processes import Failed, Supervisor, serve
from pipeline.words.progress import Progress

_MOST_MEMORY, _LONGEST = 1 << 50, 86_400.0  # bytes and s: the work is the user's own, so no limits


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
        setup = {"module": module, "function": function}
        self._worker = Supervisor(__name__, memory=_MOST_MEMORY, setup=setup)
        self._is_used = module not in sys.modules
        if self._is_used:
            with suppress(OSError):  # the computer cannot start another process
                self._worker.launch()

    def __enter__(self) -> "SecondProcess":
        return self

    def __exit__(self, *raised: object) -> None:
        self._worker.close()

    def do(self, *args: Any, progress: Progress, **named: Any) -> Any:
        """Call the function with these arguments and return its answer.

        If the second process fails for any reason, this process does the work.
        """
        if self._is_used:
            with suppress(Failed, OSError, pickle.PickleError):
                task = _pack((args, named))
                return _unpack(self._worker.do(task, limit=_LONGEST, progress=progress))
        return getattr(import_module(self._module), self._function)(
            *args, progress=progress, **named
        )


def _pack(value: object) -> str:
    return b64encode(pickle.dumps(value)).decode("ascii")


def _unpack(text: str) -> Any:
    return pickle.loads(b64decode(text))


def _prepare(module: str, function: str) -> Callable[[Any, Progress], str]:
    work = getattr(import_module(module), function)

    def do(task: str, progress: Progress) -> str:
        args, named = _unpack(task)
        return _pack(work(*args, progress=progress, **named))

    return do


if __name__ == "__main__":
    serve(_prepare)
