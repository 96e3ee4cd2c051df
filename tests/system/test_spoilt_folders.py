"""For whole submissions with random faults, every command gives a result or one line, in time."""

import json
import re
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.simulated.submission import write_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.poison import poisoned

CHANNELS: dict[str, Callable[[Array], Array]] = {
    "dead": lambda y: 0 * y,
    "constant": lambda y: 0 * y + 3.3,
    "stuck": lambda y: np.where(np.arange(y.size) < y.size // 3, y, y[y.size // 3]),
    "jumping": lambda y: y + 1e3 * (np.arange(y.size) >= y.size // 2),
    "spiked": lambda y: np.eye(1, y.size, y.size // 2)[0],
    "clipped": lambda y: np.clip(y, -0.1 * np.abs(y).max(), 0.1 * np.abs(y).max()),
    "noisy": lambda y: np.random.default_rng(y.size).standard_normal(y.size),
    "reversed": lambda y: y[::-1],
    "negated": lambda y: -y,
    "offset": lambda y: y + 1e6,
    "ramp": lambda y: np.arange(y.size, dtype=float),
    "huge": lambda y: 1e40 * y,
    "large": lambda y: 1e6 * y,
    "small": lambda y: 1e-6 * y,
    "tiny": lambda y: 1e-40 * y,
}
LENGTHS = (slice(None), slice(None), slice(None), slice(8), slice(40), slice(0, None, 2))

# Processor time, which does not depend on other programs. `gap` also has its own limit.
MOST_TIME = 60.0  # s
KINDS = ("decay", "step", "sine", "sweep", "closed_loop", "bode")
FACTORS = (1e-9, 1e-3, 0.1, 0.5, 0.97, 2, 10, 1e3, 1e9)
ADDED = (
    "window = [1.0, 2.0]", "window = [0.0, 0.05]", "window = [3.0, 1e9]", "sample_rate = 1000.0",
    "reference = 1e-9", "reference = -1.0", "input = { sign = -1 }", "input = { per_count = 1e6 }",
    "columns = { time = 2, x1 = 1 }", 'columns = { time = "time", input = "x1", x1 = "x1" }',
    'hold = "band_limited"', "controlled_cart = 1", "frequency = 60.0", "frequency = 1e-3",
    'controller = { type = "pid", kp = 0.05, ki = 1e9, kd = 0.0 }',
    'controller = { type = "state_feedback", gains = [0.01, 0.001], prefilter = 0.0 }',
    'controller = { type = "state_feedback", gains = [1e9, 0, 0, -1e9] }',
)  # fmt: skip


@cache
def good(carts: int) -> dict[str, bytes]:
    """Return the files of a small submission with few dwells and few repeats."""
    with tempfile.TemporaryDirectory() as folder:
        write_submission(Path(folder), f"throne-{carts}dof", seed=1, compact=True, reported=True)
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in Path(folder).rglob("*.*")
        }
    head, *runs = files.pop("submission.toml").decode().split("[[experiments]]\n")
    tail = runs[-1].partition("\n[reported")
    runs[-1] = tail[0] + "\n"
    kept = [run for run in runs if not re.match(r'id = "sine-(?!04|08|11|14|17|20)', run)]
    named = {re.search(r'file = "(.*)"', run)[1] for run in kept}  # type: ignore[index]
    toml = "[[experiments]]\n".join([head, *kept]) + "".join(tail[1:])
    return {name: files[name] for name in sorted(named)} | {"submission.toml": toml.encode()}


def odd(files: dict[str, bytes], rng: Random) -> None:
    """Replace what a submission states about its bench and runs by other plausible values."""
    toml = files["submission.toml"].decode("utf-8", "replace")

    def change(pattern: str, *new: str) -> str:
        there = list(re.finditer(pattern, toml, re.MULTILINE))
        if not there:
            return toml
        at = rng.choice(there)
        return toml[: at.start()] + rng.choice(new) + toml[at.end() :]

    n = rng.randint(1, 4)
    springs = ", ".join(rng.choice(["true", "false"]) for _ in range(n + 1))
    free = sorted(rng.sample(range(1, n + 1), rng.randint(1, n)))
    typed = re.findall(r"^file = .*$", toml, re.MULTILINE) or [""]
    number = rng.choice(list(re.finditer(r"(?<== )-?[\d.]+(?:e-?\d+)?$", toml, re.MULTILINE)))
    scaled = f"{float(number[0]) * rng.choice(FACTORS) or 1.0:.6g}"
    files["submission.toml"] = rng.choice(
        [
            change(r"^carts = \d\nsprings = .*$", f"carts = {n}\nsprings = [{springs}]"),
            change(r"^springs = .*$", f"springs = [{springs}]"),
            change(r"^carts = \[.*\]$", f"carts = {free}"),
            change(r"^kind = .*$", *(f'kind = "{kind}"' for kind in KINDS)),
            change(r"^kind = .*$", *(f'kind = "{kind}"' for kind in KINDS)),
            change(r"^file = .*$", *typed),
            change(r"^(?=file = )", *(f"{line}\n" for line in ADDED)),
            change(r"^(?=file = )", *(f"{line}\n" for line in ADDED)),
            change(r'unit = "cm"', 'unit = "cm", per_count = 0.00227', 'unit = "µm"'),
            change(r'method = "lqr"', 'method = "poles"'),
            change(r"^overshoot_percent = .*$", "overshoot_percent = 0", "overshoot_percent = 99"),
            toml[: number.start()] + scaled + toml[number.end() :],
        ]
    ).encode()


def spoil_channel(files: dict[str, bytes], rng: Random, *, every: bool) -> None:
    """Spoil one column of a table, or of all tables, as a faulty bench may do; perhaps cut it."""
    tables = sorted(name for name in files if name.endswith(".csv"))
    how, column = CHANNELS[rng.choice(sorted(CHANNELS))], rng.randrange(1, 5)
    length = rng.choice(LENGTHS)
    for name in tables if every else [rng.choice(tables)]:
        spoil_table(files, name, how, column=column, length=length)


def spoil_table(
    files: dict[str, bytes],
    name: str,
    how: Callable[[Array], Array],
    *,
    column: int,
    length: slice = LENGTHS[0],
) -> None:
    """Spoil one column of a table, if it has so many, and keep a part of the rows."""
    try:
        head, *rows = files[name].decode().splitlines()
        values = np.array([row.split(",") for row in rows], dtype=float)
    except ValueError:  # spoilt already
        return
    if values.ndim == 2 and len(values) and column < values.shape[1]:
        values[:, column] = how(values[:, column])
        lines = [head, *(",".join(f"{value:.9g}" for value in row) for row in values[length])]
        files[name] = "\n".join(lines).encode()


def spoilt(carts: int, rng: Random) -> dict[str, bytes]:
    """Return a submission with the given number of carts and a few random faults."""
    files = dict(good(carts))
    for _ in range(rng.choice([1, 1, 2, 4])):
        if rng.random() < 0.6:
            odd(files, rng)
        else:
            spoil_channel(files, rng, every=rng.random() < 0.4)
    return poisoned(files, rng) if rng.random() < 0.3 else files


def run(command: str, folder: Path) -> None:
    """Run a command on a submission folder, and check its exit status and what it wrote."""
    out = folder.parent / "out"
    document = {"report": "results.json"}.get(command, f"{command}.json")
    began = time.process_time()
    if command == "import":
        (folder / "submission.toml").replace(folder / "data" / "submission.toml")
        cartlab_here("new", folder / "work", "--carts", "2")
        document = ""
        done = cartlab_here("acquire", folder / "work", "--import", folder / "data", "--once")
    else:
        done = cartlab_here(command, folder, "--out", out, "--no-pdf")
    assert time.process_time() - began < MOST_TIME
    assert done.returncode in (0, 1, 2)
    if done.returncode == 2:
        *_, last = done.stderr.splitlines()
        assert re.fullmatch(r"cartlab: .{10,1000}", last), done.stderr
    elif document:
        json.loads((out / document).read_text(encoding="utf-8"), parse_constant=_refuse)


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def run_on(command: str, files: dict[str, bytes]) -> None:
    """Run a command on a submission with these files."""
    with tempfile.TemporaryDirectory() as base:
        for name, raw in files.items():
            path = Path(base) / "work" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(raw)
        run(command, Path(base) / "work")


def try_seed(command: str, seed: int) -> None:
    """Spoil a submission at random, and run a command on it."""
    rng = Random(f"{command} {seed}")
    run_on(command, spoilt(1 + seed % (2 if command == "gap" else 3), rng))


@pytest.mark.parametrize("command", ["report", "import"])
def test_a_spoilt_submission_gives_a_result_or_one_line(command):
    """For two spoilt submissions, `report` and `import` give a result or one line of error."""
    for seed in (0, 3):
        try_seed(command, seed)


LONG = [pytest.mark.slow, pytest.mark.sample]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(
    ("carts", "every"),
    [(1, 1), (1, 2), *(pytest.param(*case, marks=LONG) for case in ((2, 1), (2, 2), (3, 2)))],
)
def test_spoilt_channels_of_every_kind_give_a_result_or_one_line(carts, every):
    """Each recording has another fault in one of its columns; or only every second has.

    If all have one, a third of them is also stated to be of another kind.
    """
    files = dict(good(carts))
    runs = files["submission.toml"].decode().split("\nkind = ")
    faults = sorted(CHANNELS)
    for i, name in enumerate(sorted(name for name in files if name.endswith(".csv"))):
        if i % every == 0:
            how = CHANNELS[faults[(i // every + 5 * carts) % len(faults)]]
            columns = files[name].partition(b"\n")[0].count(b",")
            spoil_table(files, name, how, column=1 + i // every % columns)
    if every == 1:
        for i in range(1, len(runs), 3):
            runs[i] = f'"{KINDS[i % len(KINDS)]}"\n' + runs[i].partition("\n")[2]
    run_on("report", files | {"submission.toml": "\nkind = ".join(runs).encode()})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "seeds"), [("report", 300), ("solution", 100), ("import", 300), ("gap", 30)]
)
def test_no_command_on_a_spoilt_submission_crashes(command, seeds):
    """For hundreds of spoilt submissions, every command gives a result or one line of error."""
    for seed in range(seeds):
        try_seed(command, seed)
