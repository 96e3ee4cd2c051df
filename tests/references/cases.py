"""Run the commands on every input, and return the facts of what they write."""

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import tomlkit

from pipeline.cli import main
from pipeline.ingest.files import read_table
from pipeline.ingest.read import read_data
from pipeline.submission import load_submission
from tests.helpers.places import REAL_DATA, ROOT
from tests.helpers.ucsd import write_one_cart_submission, write_two_cart_submission
from tests.references.class_life import life
from tests.references.facts import Facts, read_facts, tree
from tests.references.hook import sitecustomize as hook
from tests.references.inputs import (
    FEW_TEAMS,
    HIDDEN,
    MISTAKES,
    SPOILT,
    Edit,
    Made,
    clipped,
    coarse,
    recording,
    setting,
    without,
)

Teams = Mapping[str, tuple[Edit, ...]]
EXAMPLES = ("one-cart", "two-cart", "three-cart")
_PLATFORMS = ("canvas", "moodle", "gradescope")
_LONG_GAPS = {"delay", "stop-2"}  # a minute or more each
_DATA_FILES = (".csv", ".txt", ".mat", ".m")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One command or a few, and what is read of them.

    Attributes
    ----------
    facts : returns the facts, given a folder for output.
    """

    name: str
    facts: Callable[[Path], Facts]


def run(*command: str | Path, figures: Path | None = None) -> int:
    """Run a command in this process; the numbers of its figures go to `figures`.

    Returns
    -------
    The exit status.
    """
    words = ["cartlab", *map(str, command)]
    with _watched(figures), patch.object(sys, "argv", words):
        try:
            with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
                main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


@contextmanager
def _watched(figures: Path | None) -> Iterator[None]:
    """Keep the numbers behind the figures that this process and its children draw."""
    if figures is None:
        yield
        return
    figures.mkdir(parents=True)
    if not hasattr(_watched, "on"):
        hook.watch_figures()
        _watched.on = True  # pyright: ignore[reportFunctionMemberAccess]
    paths = (str(Path(hook.__file__).parent), os.environ.get("PYTHONPATH"))
    path = os.pathsep.join(filter(None, paths))
    with patch.dict(os.environ, {"CARTLAB_FIGURES": str(figures), "PYTHONPATH": path}):
        yield


def commanded(*command: str | Path, folder: Path) -> Facts:
    """Return the facts of one command that writes a folder, with those of its figures."""
    out, figures = folder / "out", folder / "figures"
    status = run(*command, "--no-pdf", "--out", out, figures=figures)
    found: Facts = {"exit": status}
    if out.exists():
        found |= read_facts(out)
    if drawn := read_facts(figures):
        found["figures"] = drawn
    return found


def case(kind: str, name: str, submission: Callable[[], Path]) -> Case:
    """Return the case of a report, solution or gap of one submission.

    Parameters
    ----------
    submission : writes the submission, if it is not there yet, and returns its folder.
    """

    def facts(folder: Path) -> Facts:
        there = submission()
        found = commanded(kind, there, folder=folder)
        if kind == "report":
            found["records"] = records(there)
        return found

    return Case(name=f"{kind}/{name}", facts=facts)


def records(submission: Path) -> Facts:
    """Return the channels of every recording as the program uses them."""
    try:
        read = read_data(load_submission(submission))
    except Exception as error:
        return {"refused": type(error).__name__}
    return {
        one.id: {
            "kind": one.kind,
            "carts": list(one.carts),
            "free": list(one.free),
            "t": hook.summary(one.t),
            "u": None if one.u is None else hook.summary(one.u),
            **{f"x{cart}": hook.summary(one.position(cart)) for cart in one.carts},
        }
        for one in read.records
    }


def file_facts(file: Path, _folder: Path) -> Facts:
    """Return how a data file is read: what `inspect` finds, and every column."""
    said = StringIO()
    with patch.object(sys, "argv", ["cartlab", "inspect", str(file), "--json"]):
        try:
            with redirect_stdout(said), redirect_stderr(StringIO()):
                main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
    found: Facts = {"exit": status}
    if said.getvalue():
        (one,) = json.loads(said.getvalue())
        found["inspect"] = tree({k: v for k, v in one.items() if k != "file"})
        found["problems"] = len(one.get("problems", ()))
    try:
        table, _ = read_table(file.parent, file.name)
    except Exception as error:
        return found | {"refused": type(error).__name__}
    columns = zip(table.names, table.values, strict=True)
    return found | {"columns": {name: hook.summary(values) for name, values in columns}}


# ---------------------------------------------------------------------------------------- inputs


def write_made(made: Made, folder: Path) -> Path:
    """Simulate a submission and edit its files, if it is not there yet."""
    target = folder / made.name
    if not target.exists():
        assert run(*made.command(target)) == 0
        for edit in made.edits:
            edit(target)
    return target


def example(name: str) -> Path:
    """Return the folder of a shipped example."""
    return ROOT / "submissions" / name


def write_class(folder: Path, *, carts: int, teams: Teams, seed: int) -> Path:
    """Write a class in which each team makes its own mistakes."""
    for number, (team, edits) in enumerate(teams.items()):
        write_made(Made(name=team, carts=carts, seed=seed + number, edits=edits), folder)
    return folder


def write_rubric(folder: Path, *, carts: int) -> Path:
    """Write the shipped rubric, in which three criteria require each other in a chain.

    For one cart, the initial and final numbers may hardly differ.
    """
    file = folder / f"rubric-{carts}.toml"
    document: Any = tomlkit.parse((ROOT / "rubrics" / f"throne-{carts}dof.toml").read_text("utf-8"))
    for one in document["criteria"]:
        if one["id"] == "prefilter":
            one["requires"] = ["comparison"]
        if one["id"] == "comparison" and carts == 1:
            one["full_percent"], one["none_percent"] = 0.5, 4
            one["parameters"] = ["omega_*"]
    file.write_text(tomlkit.dumps(document), encoding="utf-8", newline="\n")
    return file


def graded(teams: Path, rubric: Path, folder: Path) -> Facts:
    """Grade a class, give one criterion by hand, and export it to all platforms."""
    book, figures = folder / "out", folder / "figures"
    grade = ("grade", teams, "--rubric", rubric, "--jobs", "1", "--out", book)
    found: Facts = {"exit": run(*grade, figures=figures)}
    found |= read_facts(book)
    found["figures"] = read_facts(figures)
    by_hand = ("a-honest", "laws", "0.5", "--why", "seen", "--by", "TA")
    found["override"] = {"exit": run("override", book, *by_hand)}
    found["override"] |= read_facts_of(book / "grades.csv")
    for platform in _PLATFORMS:
        out = folder / f"{platform}.csv"
        found[platform] = {"exit": run("export", book, "--lms", platform, "--out", out)}
        found[platform] |= read_facts_of(out)
    return found


def read_facts_of(file: Path) -> Facts:
    """Return the facts of one table."""
    with tempfile.TemporaryDirectory() as alone:
        if file.exists():
            shutil.copy(file, alone)
        return read_facts(Path(alone))


def class_case(inputs: Path, *, carts: int, teams: Teams, seed: int) -> Case:
    """Return the case of a class."""

    def facts(folder: Path) -> Facts:
        there = write_class(inputs / f"class-{carts}", carts=carts, teams=teams, seed=seed)
        return graded(there, write_rubric(inputs, carts=carts), folder)

    return Case(name=f"grade/class-{carts}", facts=facts)


# ----------------------------------------------------------------------------------------- lists


def gap_sample(inputs: Path) -> Iterator[Case]:
    """Yield the case of the sample that takes longest."""
    stop = Made(name="stop", carts=1, seed=5, hide=("end_stop:cart=1",))
    yield case("gap", stop.name, partial(write_made, stop, inputs))


def sample(inputs: Path) -> Iterator[Case]:
    """Yield the few cases that run with every change."""
    two: tuple[Edit, ...] = (
        without("sine", keep_every=2),
        clipped("sweep", "input", side=-1),
        setting("design", "input_limit", 0.08),
    )
    rough = Made(
        name="rough", carts=1, seed=5, hide=("coulomb_friction:cart=1",),
        edits=(without("sine", "sweep"), recording("*", coarse)),
    )  # fmt: skip
    for made in (Made(name="two", carts=2, seed=7, edits=two), rough):
        yield case("report", made.name, partial(write_made, made, inputs))
    yield case("solution", "two-cart", partial(example, "two-cart"))
    yield class_case(inputs, carts=1, teams=FEW_TEAMS, seed=40)


def everything(inputs: Path) -> Iterator[Case]:
    """Yield all cases; those of real measurements only if these are beside the project."""
    sets = [
        Made(name=f"plain-{carts}-{seed}", carts=carts, seed=seed)
        for carts in (1, 2, 3)
        for seed in (1, 2)
    ]
    sets += [
        Made(name=name, carts=carts, seed=5, hide=(hide,)) for name, (carts, hide) in HIDDEN.items()
    ]
    sets += [
        Made(name=f"spoilt-{name}", carts=2 + (number % 5 == 4), seed=7, edits=edits)
        for number, (name, edits) in enumerate(SPOILT.items())
    ]
    for made in sets:
        submission = partial(write_made, made, inputs)
        yield case("report", made.name, submission)
        if made.name in HIDDEN.keys() - _LONG_GAPS or made.name.startswith("plain-2"):
            yield case("gap", made.name, submission)
        if made.name.endswith(("-1", "springs", "low-limit", "cubic")):
            yield case("solution", made.name, submission)
    for name in EXAMPLES:
        for kind in ("report", "solution", "gap"):
            yield case(kind, f"example-{name}", partial(example, name))
    yield class_case(inputs, carts=2, teams=MISTAKES, seed=100)
    yield class_case(inputs, carts=1, teams=FEW_TEAMS, seed=200)
    yield class_case(inputs, carts=3, teams=FEW_TEAMS, seed=300)
    for name in ("named", "anonymous"):
        yield Case(name=f"life/{name}", facts=partial(life, anonymous=name == "anonymous"))
    yield from real_cases(inputs)


def real_cases(inputs: Path) -> Iterator[Case]:
    """Yield the cases of real measurements."""
    if not REAL_DATA.is_dir():
        return
    one_cart = partial(write_one_cart_submission, data=REAL_DATA)
    two_carts = partial(write_two_cart_submission, data=REAL_DATA, steps=(1, 2, 3, 4, 5))
    for file in sorted(p for p in REAL_DATA.rglob("*") if p.suffix in _DATA_FILES):
        name = "-".join(file.relative_to(REAL_DATA).parts)
        yield Case(name=f"inspect/{name}", facts=partial(file_facts, file))
    for kind in ("report", "gap"):
        yield case(kind, "real-one", partial(_real, inputs / "real-one", one_cart))
    for kind in ("report", "solution"):  # its gap takes minutes
        yield case(kind, "real-two", partial(_real, inputs / "real-two", two_carts))


def _real(folder: Path, write: Callable[[Path], Path]) -> Path:
    return folder if folder.exists() else write(folder)
