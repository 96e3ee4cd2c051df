"""Check that a refactoring does not change a byte of the program's output.

`python -m tests.references save FOLDER` runs the commands and keeps their output; `python -m
tests.references compare FOLDER` runs them again and lists every file that differs. Name parts
(report, solution, gap, grade, inspect, plan) to run only those.
"""

import argparse
import filecmp
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.helpers.places import REAL_DATA, ROOT
from tests.helpers.ucsd import write_two_cart_submission

EXAMPLES = ("one-cart", "two-cart", "three-cart")
# Columns of a gradebook that differ from run to run, or from version to version.
CLOCKS = frozenset({"at", "key"})
LEFT_OUT = frozenset({".pdf", ".sqlite", ".zip"})  # their text, rows and files are compared instead
BOOKKEEPING = frozenset({".lock", ".turn", ".made.json"})  # differ from version to version


def main() -> int:
    """Save the references, or compare with them; return 1 if something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("save", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", help=", ".join(PARTS))
    asked = parser.parse_args()
    parts = asked.parts or list(PARTS)
    if unknown := set(parts).difference(PARTS):
        parser.error(f"{unknown}: no such part")
    if asked.what == "save":
        for part in parts:
            write(part, asked.folder.resolve() / part)
        return 0
    found = 0
    for part in parts:
        with tempfile.TemporaryDirectory() as scratch:
            write(part, Path(scratch) / part)
            for line in differences(asked.folder / part, Path(scratch) / part):
                sys.stdout.write(f"{line}\n")
                found += 1
    sys.stdout.write(f"{found} differences\n")
    return min(found, 1)


def write(part: str, out: Path) -> None:
    """Run the commands of one part; write their files and messages to `out`."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    PARTS[part](out)
    for book in sorted(out.rglob("gradebook.sqlite")):
        book.with_suffix(".txt").write_text("\n".join(sorted(_rows(book))), encoding="utf-8")
    for path in sorted(out.rglob("*")):
        if path.suffix in LEFT_OUT or path.name in BOOKKEEPING:
            path.unlink()


def differences(old: Path, new: Path) -> Iterator[str]:
    """Yield the files that are missing, new or different."""
    names = {path.relative_to(top) for top in (old, new) for path in top.rglob("*")}
    for name in sorted(names):
        before, after = old / name, new / name
        if not after.exists():
            yield f"missing: {old.name}/{name}"
        elif not before.exists():
            yield f"new: {old.name}/{name}"
        elif before.is_file() and not filecmp.cmp(before, after, shallow=False):
            kept = Path(tempfile.gettempdir(), "cartlab-differs", old.name, name)
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(after, kept)
            yield f"differs: diff {before} {kept}"


def _reports(out: Path) -> None:
    for name in EXAMPLES:
        _run(out / f"{name}.txt", "report", ROOT / "submissions" / name, "--out", out / name)
    with tempfile.TemporaryDirectory() as scratch:
        real = write_two_cart_submission(Path(scratch, "real"), REAL_DATA, steps=(1, 2, 3))
        _run(out / "real.txt", "report", real, "--out", out / "real", "--tables")
    (out / "real" / "results.mat").unlink()  # its first line says when it was written


def _solutions(out: Path) -> None:
    for name in EXAMPLES:
        _run(out / f"{name}.txt", "solution", ROOT / "submissions" / name, "--out", out / name)


def _gaps(out: Path) -> None:
    _run(out / "one-cart.txt", "gap", ROOT / "submissions" / "one-cart", "--out", out / "one-cart")
    with tempfile.TemporaryDirectory() as scratch:
        for name, preset, effect in (
            ("friction", "throne-1dof", "coulomb_friction:cart=1"),
            ("spring", "throne-2dof", "cubic_spring:spring=2"),
        ):
            folder = Path(scratch, name)
            hide = ("--preset", preset, "--hide", effect, "--seed", "5")
            _run(out / f"{name}-made.txt", "simulate", *hide, "--out", folder)
            _run(out / f"{name}.txt", "gap", folder, "--out", out / name)


def _grades(out: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        teams = Path(scratch, "class")
        for seed in (1, 2, 3):
            what = ("--preset", "throne-1dof", "--seed", str(seed), "--reported")
            _run(out / f"team-{seed}.txt", "simulate", *what, "--out", teams / f"team-{seed}")
        one, other = (next((teams / f"team-{seed}" / "data").glob("decay*")) for seed in (2, 3))
        shutil.copyfile(one, other)  # team 3 copies a recording; team 2 reports Hz for rad/s
        file = teams / "team-2" / "submission.toml"
        text = file.read_text(encoding="utf-8")
        file.write_text(re.sub(r"omega_n = .+", "omega_n = 0.987", text), encoding="utf-8")
        # One process, so that rows are numbered in the order of the submissions' names.
        how = ("--rubric", ROOT / "rubrics" / "throne-1dof.toml", "--jobs", "1")
        _run(out / "said.txt", "grade", teams, *how, "--out", out / "grades")
        book = out / "grades"
        change = (book, "team-2", "final", "1", "--why", "seen", "--by", "TA")
        _run(out / "override.txt", "override", *change)
        _run(out / "again.txt", "grade", teams, *how, "--out", book)
        for lms in ("canvas", "moodle", "gradescope"):
            _run(out / f"{lms}.csv", "export", book, "--lms", lms)


def _inspections(out: Path) -> None:
    files = sorted(p for p in REAL_DATA.rglob("*") if p.suffix in (".csv", ".txt", ".mat", ".m"))
    for file in files:
        name = "-".join(file.relative_to(REAL_DATA).parts)
        _run(out / f"{name}.txt", "inspect", file)
        _run(out / f"{name}.json", "inspect", file, "--json")
    _run(out / "effects.txt", "effects")
    for rubric in sorted((ROOT / "rubrics").glob("*.toml")):
        _run(out / f"{rubric.stem}.txt", "check-rubric", rubric)


def _plans(out: Path) -> None:
    shutil.copytree(ROOT / "submissions" / "one-cart", out / "one-cart")
    _run(out / "one-cart.txt", "plan", out / "one-cart", "--next", "2")
    with tempfile.TemporaryDirectory() as scratch:
        new = Path(scratch, "new")
        _run(out / "new.txt", "new", new, "--carts", "2")
        _run(out / "plan.txt", "plan", new)
        shutil.copytree(new, out / "new")


PARTS = {
    "report": _reports,
    "solution": _solutions,
    "gap": _gaps,
    "grade": _grades,
    "inspect": _inspections,
    "plan": _plans,
}


def _run(said: Path, *command: str | Path) -> None:
    """Run one command; store its exit status and messages, without the paths of this run."""
    done = subprocess.run(
        [sys.executable, "-m", "pipeline", *map(str, command)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        encoding="utf-8",
    )
    told = re.sub(r"^.* … \d+ s\n", "", done.stderr, flags=re.MULTILINE)  # progress lines
    text = f"{done.stdout}\n--\n{told}\nexit {done.returncode}\n"
    for part in command:
        if isinstance(part, Path):
            text = text.replace(str(part.parent), "…")
    said.write_text(text, encoding="utf-8")


def _rows(book: Path) -> Iterator[str]:
    """Yield every row of a gradebook as text, without the times at which the rows were written."""
    with sqlite3.connect(book) as open_book:
        query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
        for (table,) in open_book.execute(query).fetchall():
            found = open_book.execute(f'SELECT * FROM "{table}"')
            names = [column[0] for column in found.description]
            for row in found:
                kept = {n: v for n, v in zip(names, row, strict=True) if n not in CLOCKS}
                yield f"{table} {kept}"


if __name__ == "__main__":
    sys.exit(main())
