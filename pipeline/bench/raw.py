"""The raw file of a run: one line of description, then the bytes exactly as they arrived.

`<name>.raw` contains one line of JSON and then the bytes from the port. `<name>.times` next to it
has sixteen bytes for each chunk: the position of the chunk's end, and its time. Both files only
grow, so they can be read even if the program is killed.
"""

import json
import struct
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from pipeline.errors import DataError
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.output import own_folder
from pipeline.protocol import Description

FOLDER = "raw"
_VERSION = "cartlab-raw/1"
_TIME = struct.Struct("<Qd")  # position of the chunk's end in the stream, s since the run began
_LINE = ("target", "duty", "milliseconds")  # the fields of a line after the encoders


@dataclass(frozen=True, kw_only=True)
class RawHeader:
    """The description of a run in its raw file.

    Attributes
    ----------
    recording, limits : copies of the recording and the limits in the plan.
    commands : commands that started the run, in the order sent.
    bench : the bench's description of itself; for a stock bench, only the known facts.
    begun : local time of the start, with its offset from UTC.
    """

    recording: Recording
    limits: PlanLimits
    commands: tuple[str, ...]
    bench: Description
    begun: str

    def to_json(self) -> str:
        """Return the description as one line of JSON."""
        bench = {**asdict(self.bench), "commands": "".join(sorted(self.bench.commands))}
        content = {
            "schema": _VERSION,
            "recording": self.recording.model_dump(mode="json"),
            "limits": self.limits.model_dump(mode="json"),
            "commands": list(self.commands),
            "bench": bench,
            "line": [*(f"encoder {i + 1}" for i in range(self.bench.encoders)), *_LINE],
            "begun": self.begun,
        }
        return json.dumps(content, ensure_ascii=False)


class RawWriter:
    """Write arriving bytes to disk at once, so that they are kept if the program is killed.

    Raises
    ------
    FileExistsError : the file exists; a raw file is never overwritten.
    """

    def __init__(self, path: Path, header: RawHeader) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without a buffer, the system has the bytes when each write returns.
        self._bytes = path.open("xb", buffering=0)
        times = path.with_suffix(".times")
        # Remove the times of a raw file that was deleted. If the path is a link, its target stays.
        times.unlink(missing_ok=True)
        self._times = times.open("xb", buffering=0)
        self._bytes.write(header.to_json().encode() + b"\n")
        self._length = 0
        self._began = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._bytes.close()
        self._times.close()

    def write(self, data: bytes) -> None:
        """Append bytes that have just arrived."""
        self._bytes.write(data)
        self._length += len(data)
        self._times.write(_TIME.pack(self._length, time.monotonic() - self._began))


@dataclass(frozen=True, kw_only=True)
class RawRun:
    """The content of a raw file.

    Attributes
    ----------
    content : the bytes as they arrived; the last line may be incomplete.
    arrivals : the end of each chunk in `content`, and its time in s since the run began.
    """

    header: RawHeader
    content: bytes
    arrivals: tuple[tuple[int, float], ...]

    def lumps(self) -> Iterator[tuple[bytes, float]]:
        """Yield each chunk of bytes with its time; bytes without a time come last."""
        start, at = 0, 0.0
        for end, at in self.arrivals:
            yield self.content[start:end], at
            start = end
        if start < len(self.content):
            yield self.content[start:], at


def read_raw(path: Path) -> RawRun:
    """Read a raw file, even if it ends at an arbitrary byte.

    Raises
    ------
    DataError : the file is not a raw file, or its header is incomplete.
    """
    raw = path.read_bytes()
    head, newline, content = raw.partition(b"\n")
    if not newline or len(head) > 100_000:  # bytes
        raise DataError(f"{path.name}: not a raw file of a bench: its first line is not a header")
    header = _header(head, name=path.name)
    times = path.with_suffix(".times")
    packed = times.read_bytes() if times.exists() else b""
    whole = len(packed) - len(packed) % _TIME.size
    arrivals = [(end, at) for end, at in _TIME.iter_unpack(packed[:whole]) if end <= len(content)]
    return RawRun(header=header, content=content, arrivals=tuple(arrivals))


def _header(line: bytes, *, name: str) -> RawHeader:
    try:
        found: dict[str, Any] = json.loads(line)
        if found["schema"] != _VERSION:
            raise DataError(f"{name}: has the form {found['schema']!r}, expected {_VERSION!r}")
        bench = {**found["bench"], "commands": frozenset(found["bench"]["commands"])}
        return RawHeader(
            recording=Recording.model_validate(found["recording"]),
            limits=PlanLimits.model_validate(found["limits"]),
            commands=tuple(found["commands"]),
            bench=Description(**bench),
            begun=found["begun"],
        )
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{name}: not a raw file of a bench: {error!r}") from None


def free_raw_path(folder: Path, recording: Recording) -> Path:
    """Return an unused path for a raw file; each attempt at a recording gets a separate file."""
    parent = own_folder(folder, FOLDER)
    number = 1
    while (path := parent / f"{recording.id}-{number}.raw").exists():
        number += 1
    return path


def known_commands(folder: Path) -> frozenset[str]:
    """Return the extra commands of the bench that made the latest recording.

    Before the first recording, assume that the bench knows only the chirp.
    """
    for path in sorted((folder / FOLDER).glob("*.raw"), key=lambda p: p.stat().st_mtime)[::-1]:
        try:
            return read_raw(path).header.bench.commands
        except DataError:
            continue
    return frozenset("c")
