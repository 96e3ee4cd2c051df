"""Write data files of recordings, and their experiments and scales in submission.toml."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.bench.raw import FOLDER, RawRun, read_raw
from pipeline.bench.stream import Stream
from pipeline.errors import ConfigError, DataError
from pipeline.experiments.plan import Plan, PlanLimits, Recording
from pipeline.ingest.columns import is_count
from pipeline.ingest.read import DUTY_COUNT
from pipeline.output import new_folder, own_folder, write_file
from pipeline.protocol import FULL_SCALE, Description, Reading
from pipeline.submission import Submission, load_submission
from pipeline.submission.edit import append_experiment, edit_submission
from pipeline.submission.load import NAME, spring_names
from pipeline.submission.toml import Value, toml_section

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


_TO_ADD = """\
# Who you are, one table for each of you:
#[[authors]]
#id = "s1024"

# The controller to design; `cartlab new` writes every key with a comment.
#[design]
#cart = 1                         # whose position is controlled
#reference = 1.0                  # size of the step, in position units
#overshoot_percent = 10.0
#settling_time = 1.0              # s, to within 2 %
"""


def add_experiment(submission: Submission, entry: Mapping[str, Value]) -> Submission:
    """Add an `[[experiments]]` table to submission.toml; existing text and comments are kept.

    Raises
    ------
    SubmissionError : the file cannot be changed, or the result would be invalid.
    """
    return edit_submission(submission.folder, lambda document: append_experiment(document, entry))


def recorded_entry(
    recording: Recording, *, file: str, controller: dict[str, Value] | None, remarks: Sequence[str]
) -> dict[str, Value]:
    """Return the keys of the `[[experiments]]` table of a recording."""
    entry: dict[str, Value] = {
        "id": recording.id,
        "kind": recording.kind,
        "carts": list(recording.carts),
        "file": file,
    }
    if recording.kind == "sine":
        entry["frequency"] = recording.frequency
    if recording.controller is not None and controller is not None:
        entry["controlled_cart"] = recording.controller.cart
        entry["controller"] = controller
    note = "; ".join([recording.note, *remarks] if recording.note else remarks)
    if note:
        entry["note"] = note
    return entry


def check_files(plan: Plan, submission: Submission) -> None:
    """Raise ConfigError if a recording would overwrite the data of another experiment."""
    taken = {(submission.folder / e.file).resolve(): e.id for e in submission.experiments}
    for recording in plan.recordings:
        name = data_file(recording)
        other = taken.get((submission.folder / name).resolve(), recording.id)
        if other != recording.id:
            raise ConfigError(
                f"plan.toml: {recording.id}: {name} holds the experiment {other!r}; choose "
                "another id"
            )


def prepare_submission(folder: Path, bench: Description, *, stock: bool) -> Submission:
    """Write the bench's scales into a submission that lacks them; return the submission.

    A folder without a submission gets one, made from the bench's description.

    Raises
    ------
    ConfigError : the bench has too few carts, states a scale in another unit, or sends no
        description for a new submission.
    """
    if not (folder / NAME).exists():
        if stock:
            raise ConfigError(
                f"{folder}: has no {NAME}, and the bench does not say what it is: begin with "
                f"`cartlab new {folder} --carts N`"
            )
        _write_new(folder, bench)
    submission = load_submission(folder)
    system = submission.system
    if system.carts > bench.encoders:
        raise ConfigError(
            f"{folder}: has {system.carts} carts, but the bench has {bench.encoders} encoders"
        )
    if not stock and system.carts > bench.carts:
        raise ConfigError(
            f"{folder}: has {system.carts} carts, but the bench {bench.name!r} has {bench.carts}: "
            "are port and folder right?"
        )
    missing: dict[str, float] = {}
    if system.position.per_count is None:
        counts = stock or is_count(system.position.unit)
        stated = ("count", 1.0) if counts else (bench.position_unit, bench.position_per_count)
        missing["position"] = _scale(folder, "position", system.position.unit, stated)
    if system.input.per_count is None:
        stated = ("V", DUTY_COUNT) if stock else (bench.input_unit, bench.input_per_count)
        missing["input"] = _scale(folder, "input", system.input.unit, stated)
    if missing:
        _add_scales(folder / NAME, missing)
    return load_submission(folder)


def scale_remarks(submission: Submission, bench: Description) -> list[str]:
    """Return a note on each scale of the submission that differs from the bench's scale."""
    system = submission.system
    pairs = {
        "input": (system.input, bench.input_unit, bench.input_per_count),
        "position": (system.position, bench.position_unit, bench.position_per_count),
    }
    # A smaller difference can come from a number typed with fewer digits.
    return [
        f"{NAME} has {name}.per_count = {own.per_count:g}, but the bench states {stated:g} {unit}; "
        f"the value in {NAME} is used"
        for name, (own, unit, stated) in pairs.items()
        if own.per_count and own.unit == unit and abs(own.per_count / stated - 1) > 1e-3
    ]


def cart_remarks(submission: Submission, bench: Description) -> list[str]:
    """Return notes if the bench states more carts than the submission has."""
    carts = submission.system.carts
    if not bench.commands or bench.carts <= carts:
        return []
    return [
        f"{NAME} has carts = {carts}, but the bench {bench.name!r} has {bench.carts}: if it is the "
        f"right bench, hold the cart{'s' if bench.carts - carts > 1 else ''} after cart {carts} "
        "throughout"
    ]


def limit_words(limits: PlanLimits, submission: Submission, bench: Description) -> str:
    """Return a plan's limits as text, with the bench's full scale and the travel in encoder counts.

    Raises
    ------
    ConfigError : the input limit is above the bench's full scale, so the plan was made for another
        bench.
    """
    system = submission.system
    unit, position = system.input.unit, system.position.unit
    full = FULL_SCALE * abs(system.input.per_count or bench.input_per_count)
    if limits.input > 1.01 * full:  # the limit may be typed with fewer digits
        raise ConfigError(
            f"plan.toml: limits.input is {limits.input:g} {unit}, but this bench gives at most "
            f"{full:g} {unit}: the plan was made for another bench, or before the bench was known. "
            "Delete plan.toml to get a new plan, or lower limits.input and every amplitude in it"
        )
    counts = limits.travel / abs(system.position.per_count or bench.position_per_count)
    return (
        f"limits: {limits.input:g} {unit} of the {full:g} {unit} that the bench can give, and "
        f"{limits.travel:g} {position} ({counts:.0f} counts) from each cart's zero"
    )


def _scale(folder: Path, name: str, unit: str, stated: tuple[str, float]) -> float:
    stated_unit, per_count = stated
    if unit != stated_unit and not (is_count(unit) and is_count(stated_unit)):
        raise ConfigError(
            f"{folder.resolve().name}/{NAME}: state how many {unit} one count is (the bench states "
            f'{stated_unit}): {name} = {{ unit = "{unit}", per_count = … }} under [system]'
        )
    return per_count


def _add_scales(path: Path, scales: Mapping[str, float]) -> None:
    import tomlkit  # imported late: it takes 50 ms, and only a first session needs it

    document = tomlkit.parse(path.read_bytes().decode("utf-8-sig"))
    system = document["system"]
    for name, per_count in scales.items():
        if name not in system:  # pyright: ignore[reportOperatorIssue]
            system[name] = tomlkit.inline_table()  # pyright: ignore[reportIndexIssue]
        system[name]["per_count"] = per_count  # pyright: ignore[reportIndexIssue]
    write_file(path, tomlkit.dumps(document))


def _write_new(folder: Path, bench: Description) -> None:
    system: dict[str, Value] = {
        "carts": bench.carts,
        "input": {"unit": bench.input_unit, "sign": 1, "per_count": bench.input_per_count},
        "position": {"unit": bench.position_unit, "per_count": bench.position_per_count},
    }
    new_folder(folder).mkdir(parents=True, exist_ok=True)
    there = ", ".join(["true"] * (bench.carts + 1))
    names = ", ".join(spring_names(bench.carts))
    springs = f"springs = [{there}]  # check: {names}; false for a missing spring"
    sections = [
        toml_section("", {"version": 1, "title": f"Recorded on the bench {bench.name}"}),
        toml_section("[system]", system).rstrip() + f"\n{springs}\n",
        _TO_ADD,
    ]
    write_file(folder / NAME, "\n".join(sections))
