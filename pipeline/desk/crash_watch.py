"""The process that outlives a desk: it writes the log, and reports a killed or crashed desk.

It runs as a file, `python crash_watch.py LOG PID`, so that nothing is imported. Its stdin is a pipe
from the desk. A line that begins with a tab goes to the log. Any other line, such as a message of
Python when a library crashes, also goes to stderr. The pipe ends with the desk, whatever the cause.
"""

import os
import signal
import sys
from datetime import UTC, datetime

REASON = "ends: "  # precedes the reason when the desk itself reports its end


def main() -> None:
    """Write the lines of the desk until the desk has ended."""
    # A terminal often sends these signals to all its processes; this one must outlive the desk.
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    path, process = sys.argv[1:]
    explained = crashed = False
    for raw in sys.stdin.buffer:
        line = raw.decode(errors="replace").rstrip("\n")
        own = line.startswith("\t")
        explained = explained or line.startswith(f"\t{REASON}")
        _log(path, process, line.lstrip("\t"))
        if not own:
            _say(line)
            crashed = True
    if not explained:
        why = "was killed: by kill -9, by the system for lack of memory, or by a library"
        if crashed:
            why = "crashed: the lines above say where"
        _log(path, process, why)
        _say(f"cartlab: the desk {why}. Files are intact: start it again. The log: {path}")


def _log(path: str, process: str, line: str) -> None:
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%SZ")
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        with os.fdopen(descriptor, "a", encoding="utf-8") as file:
            file.write(f"{now} {process} {line}\n")
    except OSError:
        pass  # the home folder is not writable: stderr has the most important lines


def _say(line: str) -> None:
    try:
        print(line, file=sys.stderr, flush=True)  # noqa: T201
    except OSError:
        pass  # the terminal is gone


if __name__ == "__main__":
    main()
