"""The `cartlab` command: parse, call one function, write, exit code.

The commands are loaded when one is run, so that Ctrl-C during loading ends the program quietly.
Only what is imported here loads before that.
"""

import sys

TYPE_CHECKING = False  # like typing's, which is slow to import
if TYPE_CHECKING:
    from pipeline.cli.common import app as app

INTERRUPTED = 130  # exit status, as usual after Ctrl-C


def __getattr__(name: str) -> object:
    """Load the application on first use."""
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
    except KeyboardInterrupt:  # nothing has started, or the message is printed already
        sys.exit(INTERRUPTED)
