"""The firmware's core, compiled here, controls like `pipeline.simulated.controller`."""

import ctypes
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.protocol import Description, format_description
from tests.helpers.places import ROOT

FIRMWARE = ROOT / "firmware"
SOURCES = sorted((FIRMWARE / "core").glob("*.c"))
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
COMPILER = shutil.which("cc")


def compile_c(target: Path, *arguments: str | Path, compiler: str | None = COMPILER) -> Path:
    """Compile with all warnings as errors; return the target."""
    assert compiler is not None
    include = f"-I{FIRMWARE / 'core'}"
    command = [compiler, *STRICT, include, "-o", target, *arguments]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


def build_library(folder: Path) -> ctypes.CDLL:
    """Compile the core into a shared library and load it."""
    path = compile_c(
        folder / "bench.so", "-O2", "-shared", "-fPIC",
        *SOURCES, FIRMWARE / "host" / "size.c", "-lm",
    )  # fmt: skip
    library = ctypes.CDLL(str(path))
    library.bench_size.restype = ctypes.c_size_t
    library.bench_receive.argtypes = (ctypes.c_void_p, ctypes.c_uint8)
    library.bench_tick.argtypes = (
        ctypes.c_void_p, ctypes.POINTER(ctypes.c_int32), ctypes.c_uint32, ctypes.c_uint32,
    )  # fmt: skip
    library.bench_tick.restype = library.bench_take.restype = ctypes.c_int16
    library.bench_take.argtypes = (ctypes.c_void_p,)
    library.read_number.argtypes = (ctypes.c_char_p, ctypes.c_bool, ctypes.POINTER(ctypes.c_double))
    library.read_number.restype = ctypes.c_bool
    library.write_integer.argtypes = (ctypes.c_char_p, ctypes.c_int32)
    library.write_integer.restype = ctypes.c_uint8
    return library


class _Settings(ctypes.Structure):
    _fields_ = (
        ("encoders", ctypes.c_uint8),
        ("period", ctypes.c_double),
        ("description", ctypes.c_char_p),
    )


class FirmwareCore:
    """The controller in C."""

    def __init__(self, library: ctypes.CDLL, description: Description) -> None:
        self._library, self._encoders = library, description.encoders
        self._settings = _Settings(  # the C code keeps using this memory
            description.encoders, description.period, format_description(description)
        )
        self._bench = ctypes.create_string_buffer(library.bench_size())
        library.bench_init(self._bench, ctypes.byref(self._settings))

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; they take effect at the next tick."""
        for byte in data:
            self._library.bench_receive(self._bench, byte)

    def tick(self, counts: Sequence[int], *, stamp: int, now: int) -> int:
        """Return the duty that is applied from now on."""
        array = (ctypes.c_int32 * self._encoders)(*counts)
        return self._library.bench_tick(self._bench, array, stamp, now & 0xFFFFFFFF)

    def take(self) -> bytes:
        """Return the bytes to send since the last call."""
        return bytes(iter(lambda: self._library.bench_take(self._bench), -1))


@contextmanager
def kept_going(serve: Callable[[Callable[[], bool]], None]) -> Iterator[None]:
    """Run `serve` in a thread while the block runs; then set its event, so that it stops."""
    done = threading.Event()
    beside = threading.Thread(target=serve, args=(done.is_set,))
    beside.start()
    try:
        yield
    finally:
        done.set()
        beside.join()


# A bench that gets no processor time may be silent for a while.
_PATIENT = (
    "from pipeline.bench import run; run.SILENCE = 5.0; from pipeline.cli import main; main()"
)


def acquire(folder: Path, *, port: str, only: Sequence[str]) -> None:
    """Run `cartlab acquire` in its own process; it assumes that people do what it asks."""
    chosen = [word for name in only for word in ("--only", name)]
    command = [
        sys.executable,
        "-c",
        _PATIENT,
        "acquire",
        folder,
        "--port",
        port,
        "--yes",
        *chosen,
    ]
    host = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)
    assert host.returncode == 0, host.stderr
