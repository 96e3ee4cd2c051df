"""The process that outlives a desk: it writes the log, and says so where the desk ended in silence.

Run as a file, `python watch.py LOG PID`, so that nothing is imported. Its stdin is a pipe from the
desk. A line that begins with a tab goes to the log; any other, such as what Python writes where a
library crashes, to stderr too. The pipe ends with the desk, whatever ended that.
"""

import os
import signal
import sys
from datetime import UTC, datetime

SAID = "ends: "  # begins the line of the desk's own about its end


def main() -> None:
    """Write what comes, until the desk is gone."""
    for name in ("SIGINT", "SIGTERM", "SIGBREAK"):  # who stops the desk often stops all it began
        if (number := getattr(signal, name, None)) is not None:
            signal.signal(number, signal.SIG_IGN)
    path, process = sys.argv[1:]
    said = crashed = False
    for raw in sys.stdin.buffer:
        line = raw.decode(errors="replace").rstrip("\n")
        own = line.startswith("\t")
        said = said or line.startswith(f"\t{SAID}")
        _log(path, process, line.lstrip("\t"))
        if not own:
            _say(line)
            crashed = True
    if not said:
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
        pass  # a home that nobody may write to: stderr has what matters


def _say(line: str) -> None:
    try:
        print(line, file=sys.stderr, flush=True)  # noqa: T201
    except OSError:
        pass  # the terminal is gone


if __name__ == "__main__":
    main()
