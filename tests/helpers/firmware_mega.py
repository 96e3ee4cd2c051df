"""Build the firmware's sketch for an Arduino Mega and run it on a simulated one."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

from tests.helpers.firmware_host import COMPILER, FIRMWARE, SOURCES, STRICT

_ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")  # Debian's arduino-core-avr
_SIMAVR = Path("/usr/include/simavr/sim_avr.h")  # libsimavr-dev
_LEFT_OUT = ("WString",)  # the core's strings need a constant that avr-gcc 5 lacks
_COMMON = (
    "-Os", "-mmcu=atmega2560", "-ffunction-sections", "-fdata-sections",
    "-DF_CPU=16000000L", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR", "-DARDUINO_AVR_MEGA2560",
)  # fmt: skip
_CPP = ("-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics")


def missing() -> str:
    """Return what a simulated Mega lacks here, or "" if nothing is missing."""
    if COMPILER is None:
        return "a C compiler"
    if not shutil.which("avr-g++"):
        return "gcc-avr"
    if not _ARDUINO.is_dir():
        return "arduino-core-avr"
    return "" if _SIMAVR.exists() else "libsimavr-dev"


def _run(*command: str | Path) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def build_sketch(folder: Path, *, encoders: int = 2) -> Path:
    """Build the sketch as arduino-cli does; a warning in our own files is an error."""
    sketch = Path(shutil.copytree(FIRMWARE / "cartlab_bench", folder / "cartlab_bench"))
    board = (sketch / "board.h").read_text(encoding="utf-8")
    board = board.replace("#define ENCODERS 2 ", f"#define ENCODERS {encoders} ")
    (sketch / "board.h").write_text(board, encoding="utf-8")
    arduino = (f"-I{_ARDUINO / 'cores/arduino'}", f"-I{_ARDUINO / 'variants/mega'}")
    for source in SOURCES:
        _run("avr-gcc", *STRICT, *_COMMON, "-c", source, "-o", folder / f"{source.stem}.o")
    _run(
        "avr-g++", "-x", "c++", *_CPP, *_COMMON, "-Wall", "-Wextra", "-Werror",
        *arduino, f"-I{FIRMWARE / 'core'}", "-include", "Arduino.h",
        "-c", sketch / "cartlab_bench.ino", "-o", folder / "sketch.o",
    )  # fmt: skip
    core = sorted((_ARDUINO / "cores/arduino").glob("*.[cS]*"))
    for source in core:
        if source.stem in _LEFT_OUT:
            continue
        language = {".c": ("-std=gnu11",), ".cpp": _CPP, ".S": ("-x", "assembler-with-cpp")}
        _run(
            "avr-gcc", "-w", *language[source.suffix], *_COMMON, *arduino,
            "-c", source, "-o", folder / f"arduino-{source.name}.o",
        )  # fmt: skip
    program = folder / "bench.elf"
    _run("avr-gcc", *_COMMON, "-Wl,--gc-sections", "-o", program, *folder.glob("*.o"), "-lm")
    return program


def memory(program: Path) -> tuple[int, int]:
    """Return the bytes of flash and RAM that a program needs, without the stack."""
    report = _run("avr-size", "-C", "--mcu=atmega2560", program)
    flash, ram = (int(size) for size in re.findall(r"(\d+) bytes", report))
    return flash, ram


class Mega:
    """A simulated board with power; its time passes only during calls such as `run`.

    Its pins are those of firmware/cartlab_bench/board.h.
    """

    def __init__(self, program: Path, folder: Path) -> None:
        path = folder / "mega.so"
        source = FIRMWARE / "host" / "mega.c"
        assert COMPILER is not None
        _run(COMPILER, "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", source,
             "-o", path, "-lsimavr")  # fmt: skip
        self._board = ctypes.CDLL(str(path))
        self._board.mega_clock.restype = ctypes.c_uint64
        assert self._board.mega_power_on(str(program).encode()) == 0

    def run(self, seconds: float) -> None:
        """Let time pass."""
        assert self._board.mega_run(round(1e6 * seconds)) == 0

    def turn(self, encoder: int, counts: int) -> None:
        """Turn an encoder at 20 µs per edge."""
        assert self._board.mega_turn(encoder, counts) == 0

    def flicker(self, encoder: int, seconds: float, *, every: float) -> None:
        """Toggle an encoder's channel at intervals of `every` s, as a broken wire does."""
        assert self._board.mega_flicker(encoder, round(1e6 * seconds), round(1e6 * every)) == 0

    @property
    def clock(self) -> float:
        """Return the seconds since power-on."""
        return 1e-6 * self._board.mega_clock()

    @property
    def duty(self) -> int:
        """Return the duty counts at the motor's pins."""
        return self._board.mega_duty()

    def send(self, data: bytes) -> None:
        """Put bytes on the line, which takes 87 µs per byte."""
        for byte in data:
            self._board.mega_send(byte)

    def take(self) -> bytes:
        """Return the bytes that came over the line since the last call."""
        return bytes(iter(self._board.mega_receive, -1))
