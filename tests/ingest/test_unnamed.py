"""Columns without headings are recognised by their signals; if unclear, cartlab asks."""

import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.ingest.files import read_table
from pipeline.ingest.read import read_data
from pipeline.ingest.table import FileTable, Format
from pipeline.ingest.unnamed import Roles, find_roles
from pipeline.resources import EXAMPLES
from pipeline.results import Record
from pipeline.submission import load_submission

RATE = 200.0
T = np.arange(2000) / RATE
ROWS = ("time", "input", "reference", "x1", "x2", "x3")


def bare(*columns: Array) -> FileTable:
    """Return a matrix without headings."""
    return FileTable(
        source="f",
        format=Format(title="matrix", positions="unknown", inputs="unknown"),
        names=tuple(str(i) for i in range(1, len(columns) + 1)),
        values=np.array(columns),
        whole=tuple(bool((c == np.round(c)).all()) for c in columns),
        lines=None,
    )


def signals(record: Record) -> dict[str, Array]:
    """Return the columns of a record that change, by role."""
    held = {"time": record.t, "input": record.u, "reference": record.reference}
    held |= {f"x{cart}": row for cart, row in zip(record.carts, record.y, strict=True)}
    return {role: row for role, row in held.items() if row is not None and np.ptp(row) > 0}


def told(columns: dict[str, Array], order: np.random.Generator) -> tuple[Roles, dict[str, int]]:
    """Return the roles found for the columns in a random order, and the right roles.

    Positions keep their own order, since nothing else says which cart a position belongs to.
    """
    roles = list(order.permutation(list(columns)))
    positions = iter(sorted(role for role in roles if role[0] == "x"))
    roles = [next(positions) if role[0] == "x" else str(role) for role in roles]
    carts = iter(range(1, 10))
    named = [f"x{next(carts)}" if role[0] == "x" else role for role in roles]
    right = {role: number for number, role in enumerate(named, 1)}
    return find_roles(bare(*(columns[role] for role in roles))), right


@pytest.mark.parametrize("example", ["one-cart", "two-cart", "three-cart"])
def test_roles_assigned_without_doubt_are_right(example):
    """In the examples, roles found without doubt are right in any order.

    Only dwells raise doubts.
    """
    asked = []
    order = np.random.default_rng(1)
    for record in read_data(load_submission(EXAMPLES / example)).records:
        got, right = told(signals(record), order)
        if got.doubts:
            asked.append(record.kind)
        else:
            assert got.columns == right, record.id
    assert set(asked) <= {"sine"}


def kinds_of(real: Path) -> dict[str, dict[str, int]]:
    """Return the exports of a real bench in open loop, with the right role of each column."""
    one = {"time": 2, "input": 6, "x1": 4}
    files = {f"DOF1_en1_input1_test{i}.csv": {"time": 2, "input": 5, "x1": 4} for i in range(1, 6)}
    files |= {f"DOF2_en12_input1_test{i}.csv": one | {"x2": 5} for i in range(1, 6)}
    files |= {"DOF2_en12_input1_test1.mat": one | {"x2": 5}}
    return {name: roles for name, roles in files.items() if (real / name).exists()}


def test_columns_of_real_exports_are_recognised(real_data):
    """In real step recordings all roles are found, although one column copies a position."""
    folder = real_data / "ecp210-ucsd"
    for name, roles in kinds_of(folder).items():
        table, _ = read_table(folder, name)
        got = find_roles(bare(*table.values))
        assert got == Roles(columns=roles), name


def test_the_input_of_a_random_record_is_found(real_data):
    """In random records of the Silverbox the input is found, in whichever column it is."""
    for name in ("SNLS80mV.mat", "Schroeder80mV.mat"):
        table, _ = read_table(real_data / "silverbox", name)
        drive, answer = (table.values[table.index(column)] for column in ("V1", "V2"))
        clock = np.arange(drive.size) / 610.35
        assert find_roles(bare(clock, answer, drive)).columns == {"time": 1, "input": 3, "x1": 2}
        assert find_roles(bare(drive, answer, clock)).columns == {"time": 3, "input": 1, "x1": 2}


def test_a_record_moved_by_hand_has_no_certain_input(real_data):
    """If carts are plucked by hand, cartlab asks which column is the input."""
    for day in ("07-Feb-2025_11_28_21", "14-Feb-2025_09_44_21"):
        table, _ = read_table(real_data / "ecp210-2025", f"{day}.txt")
        assert find_roles(bare(*table.values)).doubts


RING = np.exp(-0.5 * T) * np.cos(12 * T)
STEP = np.where(T > 1, 0.5, 0.0)
ANSWER = np.where(T > 1, 1 - np.cos(9 * (T - 1)), 0.0)


def test_a_velocity_gets_no_role():
    """A column with the rate of change of another column gets no role."""
    rate = np.where(T > 1, 9 * np.sin(9 * (T - 1)), 0.0)
    got = find_roles(bare(T, STEP, ANSWER, rate))
    assert got == Roles(columns={"time": 1, "input": 2, "x1": 3})


def test_a_reference_is_distinguished_from_the_input():
    """Although reference and controller output jump together, each gets its right role."""
    effort = STEP - 0.2 * ANSWER
    got = find_roles(bare(T, STEP, ANSWER, effort))
    assert got == Roles(columns={"time": 1, "input": 4, "reference": 2, "x1": 3})


def test_two_nearly_equal_columns_are_asked_about():
    """A smooth reference nearly equals the position that follows it, so cartlab asks."""
    path = 10 * np.sin(2 * T) * np.sin(0.3 * T)
    drive = np.gradient(np.gradient(path, T), T) + np.sin(5 * T)
    got = find_roles(bare(T, drive, path, path + 0.01 * np.sin(5 * T)))
    doubts = [doubt for doubt in got.doubts if re.search(r"\b3 and 4\b", doubt)]
    assert len(doubts) == 1


def test_a_time_in_milliseconds_is_reported():
    """A time in milliseconds is recognised, and the message proposes the sample rate."""
    got = find_roles(bare(np.round(1e3 * T), STEP, ANSWER))
    assert got.columns == {}
    (said,) = got.doubts
    assert re.search(r"\bmilliseconds\b.*\b200$", said)


def test_one_column_beside_the_time_is_a_position():
    """A single column next to the time is a position, since a release has no input."""
    assert find_roles(bare(T, RING)) == Roles(columns={"time": 1, "x1": 2})
    assert find_roles(bare(T, RING, 0.5 * RING)).columns == {"time": 1, "x1": 2, "x2": 3}


@pytest.mark.parametrize("n", [2, 3, 8, 30])
def test_short_and_constant_columns_do_no_harm(n):
    """Short or constant columns get no roles and give no error."""
    rng = np.random.default_rng(n)
    for columns in ((np.zeros(n),), (T[:n], np.zeros(n)), (T[:n], *rng.normal(size=(3, n)))):
        assert isinstance(find_roles(bare(*columns)), Roles)
