"""Write the data file of an experiment, an ordinary bench log, from a raw file."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.bench.host.raw import FOLDER, RawRun, read_raw
from pipeline.bench.host.stream import Stream
from pipeline.bench.protocol.messages import Reading
from pipeline.errors import DataError
from pipeline.experiments.plan import Recording
from pipeline.output import own_folder, write_file

DATA = "data"


def data_file(recording: Recording, *, partial: bool = False) -> str:
    """Return the path of a recording's data file, relative to the submission, with `/`."""
    return f"{DATA}/{recording.id}{'.partial' if partial else ''}.txt"


def readings_of(run: RawRun) -> tuple[Reading, ...]:
    """Return the valid lines of a run in order, by the same checks as during the run."""
    stream = Stream(
        encoders=run.header.bench.encoders,
        period=1e3 * run.header.bench.period,
        free=run.header.recording.carts,
        closed=run.header.recording.controller is not None,
    )
    lines = [reading for data, at in run.lumps() for reading in stream.feed(data, since=at, now=at)]
    return (*lines, *stream.finish())


def save_record(raw_path: Path, *, folder: Path, carts: int, partial: bool = False) -> str:
    """Write the data file of a raw file; return its path relative to the submission `folder`.

    Raises
    ------
    DataError : the raw file has too few lines.
    """
    run = read_raw(raw_path)
    readings = readings_of(run)
    if len(readings) < 8:  # the smallest number that a record needs
        raise DataError(f"{raw_path.name}: holds {len(readings)} lines, too few for a record")
    name = data_file(run.header.recording, partial=partial)
    own_folder(folder, DATA).mkdir(exist_ok=True)
    closed = run.header.recording.controller is not None
    write_file(folder / name, log_text(readings, carts=carts, reference=closed))
    return name


def log_text(readings: Sequence[Reading], *, carts: int, reference: bool) -> str:
    """Return a bench log with the counts and time stamps (in s, to the ms) that arrived.

    Parameters
    ----------
    reference : whether to add the target as a column, in encoder counts.
    """
    encoders = min(carts, len(readings[0].counts))
    heading = ["Sample", "Time", *(f"Encoder {i + 1} Pos" for i in range(encoders))]
    heading += ["Target", "Control Effort"] if reference else ["Control Effort"]
    lines = ["\t".join(heading)]
    for number, reading in enumerate(readings):
        fields = [number, f"{1e-3 * reading.ms:.3f}", *reading.counts[:encoders]]
        fields += [reading.target, reading.duty] if reference else [reading.duty]
        lines.append("\t".join(map(str, fields)))
    return "\n".join(lines) + "\n"


def save_left_over(folder: Path, *, carts: int) -> list[str]:
    """Save a partial record of each raw file that has no data file; return the new names."""
    saved = []
    for path in sorted((folder / FOLDER).glob("*.raw")):
        try:
            recording = read_raw(path).header.recording
            # Skip a file that was renamed, and an id that is a path to another folder.
            if path.stem.rpartition("-")[0] != recording.id:
                continue
            made = [folder / data_file(recording, partial=partial) for partial in (False, True)]
            if not any(file.exists() for file in made):
                saved.append(save_record(path, folder=folder, carts=carts, partial=True))
        except DataError:  # the raw file was cut off within its first lines
            continue
    return saved
