"""Which realistic faults do the tests notice, and which tests?

    python -m benchmarks.faults [--suite] [FILE …] [NUMBER …]

One fault of `faults.toml` at a time is put into a copy of this checkout. The tests of its own room
run until one fails, for at most 20 s: first those that import the faulty module, then those whose
path is most like it. With `--suite`, the default suite and its sample follow if no test
failed. The list stays true, because a fragment that is not found exactly once is refused. Seconds
are those of a processor.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from inspect import getsource
from pathlib import Path
from typing import NamedTuple

import pytest

CHECKOUT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".toml")
_LEFT = shutil.ignore_patterns(".git", ".*_cache", ".venv", "site", "build", "dist")
_ROOM_SECONDS, _SUITE_SECONDS = 20.0, 3600.0  # of a processor; then a fault counts as unnoticed
_NEAREST = 12  # files of a room; there is no time for more
_LIMIT, _NAMES = "CARTLAB_FAULT_SECONDS", "CARTLAB_FAULT_IN"  # tell a run its time and functions
_WIDER = {"suite": "not slow", "sample": "slow and sample"}
# The test of this list would notice every fault, because the right fragment is gone.
_EVERY = ("tests", "--ignore=tests/benchmarks/test_faults.py")


class Fault(NamedTuple):
    """A wrong line: file below pipeline/, fragment, its replacement, and the room of its tests."""

    file: str
    old: str
    new: str
    tests: str
    breaks: str


class Outcome(NamedTuple):
    """The test that failed, "" for none, and the processor seconds until then."""

    test: str
    seconds: float


def read_faults() -> list[Fault]:
    """Read the list of faults; refuse one whose fragment its file does not hold exactly once."""
    faults = [Fault(**entry) for entry in tomllib.loads(LIST.read_text("utf-8"))["faults"]]
    for number, fault in enumerate(faults, 1):
        times = (CHECKOUT / "pipeline" / fault.file).read_text("utf-8").count(fault.old)
        if times != 1 or fault.old == fault.new:
            raise ValueError(f"fault {number}: {fault.file} holds {fault.old!r} {times} times")
    return faults


def order_files(fault: Fault, checkout: Path) -> list[str]:
    """List the test files of the fault's room, those that are nearest to its module first."""
    module = "pipeline." + fault.file.removesuffix(".py").replace("/", ".")
    package, _, name = module.rpartition(".")
    imports = re.compile(rf"(import|from) {module}\b|from {package} import [^#]*?\b{name}\b")
    parts = set(re.split(r"[/_.]", fault.file)) - {"py"}
    names = re.compile("|".join([rf"\b{name}\b" for name in name_functions(fault)] or [r"\b\B"]))

    def distance(file: Path) -> tuple[int, int, int]:
        text = file.read_text("utf-8")
        words = set(re.split(r"[/_.]", file.relative_to(checkout / "tests").as_posix()))
        near = bool(imports.search(text)) + bool(names.search(text))
        return -near, -len(parts & words), len(text)

    files = sorted((checkout / "tests" / fault.tests).rglob("test_*.py"), key=distance)
    return [file.relative_to(checkout).as_posix() for file in files[:_NEAREST]]


def name_functions(fault: Fault) -> list[str]:
    """Name the function, class or constant with the fault, then what uses it in its file."""
    text = (CHECKOUT / "pipeline" / fault.file).read_text("utf-8")
    named, top, in_class = dict[str, str](), "", False
    for block in re.split(r"^(?= {0,4}(?:def|class) )", text, flags=re.MULTILINE)[1:]:
        indent, kind, name = re.match(r"( *)(\w+) (\w+)", block).groups()  # type: ignore[union-attr]
        top, in_class = (top, in_class) if indent else (name, kind == "class")
        name = name if in_class and name[:2] != "__" else top
        named[name] = named.get(name, "") + block
    line = text[text.rfind("\n", 0, text.index(fault.old)) + 1 :]
    names = [name for name, block in named.items() if fault.old in block] or [line.split()[0]]
    for used in names:  # which grows
        using = (name for name, block in named.items() if re.search(rf"\b{used}\b", block))
        names += [name for name in using if name not in names]
    return names


def run_tests(
    tests: Sequence[str],
    checkout: Path,
    *,
    marked: str = "not slow",
    most: float,
    about: Sequence[str] = (),
) -> Outcome:
    """Run tests until one fails, first those `about` a function, for `most` processor seconds."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider"]
    command += ["-p", "benchmarks.faults", "-m", marked, *tests]
    environment = os.environ | {
        "PYTHONPATH": str(checkout),
        _LIMIT: str(most),
        _NAMES: " ".join(about),
    }
    began = sum(os.times()[2:4])
    with subprocess.Popen(command, cwd=checkout, env=environment, stdout=subprocess.PIPE) as run:
        try:
            said = run.communicate(timeout=4 * most)[0].decode(errors="replace")
        except subprocess.TimeoutExpired:
            run.terminate()
            said = ""
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", said, re.MULTILINE)
    if said and run.returncode > 0 and not failed:
        raise RuntimeError(f"pytest could not run:\n{said}")
    return Outcome(test=failed[1] if failed else "", seconds=sum(os.times()[2:4]) - began)


# ------------------------------------------------- as a plugin of pytest, in the runs of the tests


def pytest_collection_modifyitems(config, items: list) -> None:
    """Put the tests first that name the faulty function, then those of its users."""
    place = {Path(name).resolve(): i for i, name in enumerate(config.args)}
    # A test may say `awarded` of what `award` returns, and `effects` of a private `_effects`.
    names = [re.compile(rf"\b{name.lstrip('_')}") for name in os.environ[_NAMES].split()]

    def rank(item) -> tuple[int, int]:
        text = getsource(item.obj)
        found = (i for i, name in enumerate(names) if name.search(text))
        return next(found, len(names)), place.get(item.path.resolve(), 0)

    items.sort(key=rank)


def pytest_runtest_setup() -> None:
    """Skip the tests for which no time is left."""
    if time.process_time() > float(os.environ[_LIMIT]):
        pytest.skip("the time is over")


def judge_fault(fault: Fault, checkout: Path, *, wider: bool) -> dict[str, Outcome]:
    """Return by which runs of tests the fault is noticed: room, and if not there suite, sample."""
    path = checkout / "pipeline" / fault.file
    right = path.read_text("utf-8")
    path.write_text(right.replace(fault.old, fault.new), "utf-8")
    try:
        own = order_files(fault, checkout)
        about = name_functions(fault)
        runs = {"room": run_tests(own, checkout, most=_ROOM_SECONDS, about=about)}
        for name, marked in _WIDER.items() if wider else ():
            if not any(one.test for one in runs.values()):
                runs[name] = run_tests(_EVERY, checkout, marked=marked, most=_SUITE_SECONDS)
        return runs
    finally:
        path.write_text(right, "utf-8")


def main() -> None:
    """Print a row for each fault as soon as it is known, and the counts."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults")
    parser.add_argument("chosen", nargs="*", metavar="FILE|NUMBER", help="default: all")
    parser.add_argument(
        "--suite", action="store_true", help="all tests, if those of the room notice nothing"
    )
    asked = parser.parse_args()
    chosen, wider, found = asked.chosen, asked.suite, list[dict[str, Outcome]]()
    print("| fault | what breaks | noticed by | s |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        shutil.copytree(CHECKOUT, checkout, ignore=_LEFT, symlinks=True)
        for number, fault in enumerate(read_faults(), 1):
            if chosen and not any(str(number) == c or fault.file.startswith(c) for c in chosen):
                continue
            found.append(runs := judge_fault(fault, checkout, wider=wider))
            last, (test, seconds) = list(runs.items())[-1]
            by = f"{last}: {test.removeprefix('tests/')}" if test else "nothing"
            row = f"{number} {fault.file} | {fault.breaks} | {by} | {seconds:.0f}"
            print(f"| {row} |", flush=True)
    room = [one["room"].seconds for one in found if one["room"].test]
    quick, every = sum(s < 20 for s in room), sum(any(o.test for o in r.values()) for r in found)
    print(f"\n{len(room)} of {len(found)} noticed by the room, {quick} in 20 s, {every} in all")


if __name__ == "__main__":
    main()
