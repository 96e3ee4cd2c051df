"""The `cartlab` command: parse, call one function, write, return an exit status.

The commands are loaded inside `main`, so that Ctrl-C during loading ends the program without a
traceback. Only the imports of this file come earlier.
"""

import sys

TYPE_CHECKING = False  # the same as typing.TYPE_CHECKING, which is slow to import
if TYPE_CHECKING:
    from pipeline.cli.common import app as app

INTERRUPTED = 130  # exit status, as usual after Ctrl-C
STOPPED = "stopped; repeat the command to start again"
_MODULES = ("reports", "bench", "grading", "desk", "demo", "doctor")


def __getattr__(name: str) -> object:
    """Load the application when it is first used."""
    if name == "app":
        _load_commands()
        from pipeline.cli.common import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main() -> None:
    """Run the command line."""
    try:
        from pipeline.startup import collect_seldom, one_thread

        collect_seldom()
        one_thread()
        _load_commands()
        from pipeline.cli.common import run

        run()
    except KeyboardInterrupt:  # the commands were not loaded yet
        sys.stderr.write(STOPPED + "\n")
        sys.exit(INTERRUPTED)


def _load_commands() -> None:
    from importlib import import_module

    for name in _MODULES:
        import_module(f"pipeline.cli.{name}")
