"""A PostgreSQL server for the tests, with its own folder and socket and without a network."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

NEEDED = "CARTLAB_TESTS_NEED_POSTGRESQL"  # set if a missing server is a failure, not a skip


def missing() -> str:
    """Return why no server can be started here, or "" if one can."""
    if os.name != "posix":
        return "PostgreSQL is started on POSIX only"
    if _binaries() is None:
        return "no PostgreSQL in /usr/lib/postgresql: apt-get install postgresql"
    if find_spec("psycopg") is None:
        return "no psycopg: pip install 'cartlab[postgresql]'"
    return ""


def _binaries() -> Path | None:
    found = Path("/usr/lib/postgresql").glob("*/bin/initdb")
    newest = max(found, key=lambda path: float(path.parts[-3]), default=None)
    return newest and newest.parent


@dataclass(frozen=True)
class Server:
    """A server that runs: the URL of its database, and functions that stop and start it."""

    url: str
    stop: Callable[[], None]
    start: Callable[[], None]


@contextmanager
def running() -> Iterator[str]:
    """Start a server and yield the URL of its database; remove the server afterwards."""
    with running_server() as server:
        yield server.url


@contextmanager
def running_server() -> Iterator[Server]:
    """Start a server and yield it; remove it afterwards."""
    binaries = _binaries()
    assert binaries is not None
    # Pytest's folder cannot be used, since only its owner can enter it, and the server never runs
    # as root.
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    data = folder / "data"
    user = {}
    if os.getuid() == 0:
        shutil.chown(folder, "postgres", "postgres")
        user = {"user": "postgres", "group": "postgres", "extra_groups": []}

    def run(*command: str | Path) -> None:
        subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL, **user)

    try:
        run(binaries / "initdb", "-D", data, "-U", "cartlab", "-A", "trust", "-E", "UTF8", "-N")
        options = f"-c listen_addresses='' -c unix_socket_directories={folder}"
        log = ("-l", folder / "log")

        def start() -> None:
            run(binaries / "pg_ctl", "start", "-w", "-D", data, *log, "-o", options)

        def stop() -> None:
            run(binaries / "pg_ctl", "stop", "-w", "-m", "immediate", "-D", data)

        start()
        try:
            url = f"postgresql://cartlab@/postgres?host={folder}"
            yield Server(url=url, stop=stop, start=start)
        finally:
            with suppress(subprocess.CalledProcessError):  # a test has stopped it
                stop()
    finally:
        shutil.rmtree(folder)
