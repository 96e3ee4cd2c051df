"""The bench's end of a serial line: a TCP port for `socket://`, or a pseudo-terminal."""

import errno
import json
import os
import select
import socket
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

import psutil

from pipeline.errors import ConfigError
from pipeline.output import OWNERS_FOLDER

_CHUNK = 65_536  # bytes


class Link(ABC):
    """A bench's end of a line; one host is connected at a time, and the next one waits.

    Attributes
    ----------
    connected : whether a host is connected; `receive` updates this.
    """

    def __init__(self, address: str) -> None:
        self.address, self.connected = address, False
        self._unsent = bytearray()

    @property
    def unsent(self) -> int:
        """The number of bytes that the host has not yet read."""
        return len(self._unsent)

    def send(self, data: bytes) -> None:
        """Send bytes, or keep those that the host cannot take yet; without a host, drop them."""
        if not self.connected:
            return
        self._unsent += data
        try:
            while self._unsent:
                del self._unsent[: self._write(self._unsent[:_CHUNK])]
        except BlockingIOError:
            return
        except OSError:
            self.hang_up()

    def hang_up(self) -> None:
        """Disconnect the host, if the line can, and drop the bytes that it has not read."""
        self._unsent.clear()

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Sleep until something arrives, or for `seconds`."""

    @abstractmethod
    def receive(self) -> bytes:
        """Return the bytes that arrived; b"" for nothing."""

    @abstractmethod
    def close(self) -> None:
        """Close the line."""

    @abstractmethod
    def _write(self, data: bytearray) -> int:
        """Write what the line takes now, and return how many bytes these are."""


def open_link(port: str, *, remote: bool = False) -> Link:
    """Open `socket://HOST:PORT` (port 0 for any free port) or `pty`.

    Raises
    ------
    ConfigError : the port is written differently or is taken, or other computers could reach it
        although `remote` is False.
    """
    if port == "pty":
        return _PtyLink()
    where = f"--port {port}"
    parts = urlsplit(port)
    try:
        host, number = parts.hostname, parts.port
    except ValueError:
        host = number = None
    if parts.scheme != "socket" or host is None or number is None:
        raise ConfigError(f"{where}: write socket://127.0.0.1:5555, port 0 for any, or pty")
    try:
        family, *_, address = socket.getaddrinfo(host, number, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise ConfigError(f"{where}: {error.strerror}") from None
    if not (remote or ip_address(address[0]).is_loopback):
        raise ConfigError(
            f"{where}: anyone who reaches this port can drive the bench; "
            "use 127.0.0.1, or add --remote if you mean it"
        )
    listener = socket.socket(family, socket.SOCK_STREAM)
    if sys.platform != "win32":  # on Windows it would let two emulators share a port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
    except OSError as error:
        listener.close()
        taken = "; choose another port, or 0 for any" if error.errno == errno.EADDRINUSE else ""
        raise ConfigError(f"{where}: {error.strerror}{taken}") from None
    listener.listen()
    listener.setblocking(False)
    name = f"[{host}]" if ":" in host else host
    return _SocketLink(listener, address=f"socket://{name}:{listener.getsockname()[1]}")


class _SocketLink(Link):
    def __init__(self, listener: socket.socket, *, address: str) -> None:
        super().__init__(address)
        self._listener = listener
        self._client: socket.socket | None = None
        self._ready = False  # whether bytes have arrived or a host is waiting

    def wait(self, seconds: float) -> None:
        reader = self._client or self._listener
        writers = [self._client] if self._client and self._unsent else []
        readable, writable, _ = select.select([reader], writers, [], seconds)
        self._ready = bool(readable)
        if writable:
            self.send(b"")

    def receive(self) -> bytes:
        if not self._ready:
            return b""
        self._ready = False
        if self._client is None:
            self._accept()
            return b""
        try:
            data = self._client.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError:  # the host has reset the connection
            data = b""
        if not data:
            self.hang_up()
        return data

    def _accept(self) -> None:
        with suppress(BlockingIOError, ConnectionError):
            self._client, _ = self._listener.accept()
            self._client.setblocking(False)
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connected = self._client is not None

    def _write(self, data: bytearray) -> int:
        assert self._client is not None
        return self._client.send(data)

    def hang_up(self) -> None:
        super().hang_up()
        if self._client is not None:
            self._client.close()
            self._client, self.connected = None, False

    def close(self) -> None:
        self.hang_up()
        self._listener.close()


class _PtyLink(Link):
    def __init__(self) -> None:
        if sys.platform == "win32":
            raise ConfigError(
                "--port pty: Windows has no pseudo-terminals; take socket://127.0.0.1:0"
            )
        import tty  # does not exist on Windows

        self._master, slave = os.openpty()
        tty.setraw(slave)
        super().__init__(os.ttyname(slave))
        os.close(slave)  # so that the master notices when no host has it open
        os.set_blocking(self._master, False)

    def wait(self, seconds: float) -> None:
        if self.connected:
            writers = [self._master] if self._unsent else []
            select.select([self._master], writers, [], seconds)
        else:
            time.sleep(min(seconds, 0.01))  # somebody may open the pseudo-terminal meanwhile

    def receive(self) -> bytes:
        self.send(b"")
        try:
            data = os.read(self._master, _CHUNK)
        except BlockingIOError:
            self.connected = True
            return b""
        except OSError:  # no host has it open
            data = b""
        self.connected = bool(data)
        if not data:
            self._unsent.clear()
        return data

    def _write(self, data: bytearray) -> int:
        return os.write(self._master, data)

    def close(self) -> None:
        os.close(self._master)


@dataclass(frozen=True, kw_only=True)
class RunningBench:
    """A virtual bench of the same user."""

    name: str
    address: str


@contextmanager
def announced(bench: RunningBench) -> Iterator[None]:
    """Announce a running bench to this user's desks; remove the file at the end."""
    folder, pid = _find_folder(), os.getpid()
    path = folder / f"{pid}.json"
    entry = {"name": bench.name, "address": bench.address, "began": _began(pid)}
    with suppress(OSError):  # without a folder, the bench's address can still be typed
        folder.mkdir(OWNERS_FOLDER, exist_ok=True)
        if _is_own(folder):
            for stale in (other for other in folder.glob("*.json") if _read(other) is None):
                stale.unlink(missing_ok=True)
            path.write_text(json.dumps(entry), encoding="utf-8")
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def running_benches() -> list[RunningBench]:
    """Return the virtual benches that are running now."""
    folder = _find_folder()
    if not _is_own(folder):
        return []
    found = [_read(path) for path in sorted(folder.glob("*.json"))]
    return [bench for bench in found if bench is not None]


def _find_folder() -> Path:
    """Return the path of the folder for the files; each user has a separate folder."""
    own = str(os.getuid()) if hasattr(os, "getuid") else "user"
    root = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(root) / f"cartlab-benches-{own}"


def _is_own(folder: Path) -> bool:
    """Return whether the folder exists and belongs to this user alone."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    info = folder.stat()
    return os.name != "posix" or (info.st_uid == os.getuid() and not info.st_mode & 0o022)


def _read(path: Path) -> RunningBench | None:
    """Return the bench that a file announces; None if its process has ended."""
    try:
        entry = json.loads(path.read_text(encoding="utf-8"))
        if entry["began"] != _began(int(path.stem)):
            return None
        return RunningBench(name=str(entry["name"]), address=str(entry["address"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _began(pid: int) -> float:
    """Return when a process began, s; 0 if there is no such process.

    If the system reuses the number for a new process, the time is different.
    """
    try:
        return psutil.Process(pid).create_time()
    except psutil.Error:
        return 0.0
