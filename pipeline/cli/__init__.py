"""The `cartlab` command: parse, call one function, write, exit code.

The commands are loaded when the first one runs, so that Ctrl-C during loading ends it quietly. What
is imported here is loaded before anybody can press Ctrl-C.
"""

import sys

TYPE_CHECKING = False  # as that of typing, which takes its time to load
if TYPE_CHECKING:
    from pipeline.cli.common import app as app

INTERRUPTED = 130  # exit status, as of any program that Ctrl-C ends


def __getattr__(name: str) -> object:
    """Load the application when it is asked for."""
    if name == "app":
        from pipeline.cli.commands import app

        return app
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main() -> None:
    """Run the command line."""
    try:
        from pipeline.garbage import collect_seldom
        from pipeline.threads import one_thread

        collect_seldom()
        one_thread()
        from pipeline.cli.commands import run

        run()
    except KeyboardInterrupt:  # nothing has begun yet, or the message is out
        sys.exit(INTERRUPTED)
