"""The real ECP 210 recordings, as single records or as submissions in a temporary folder."""

import shutil
from pathlib import Path

import numpy as np

from pipeline.results import Record

PID = '{ type = "pid", kp = 0.5, ki = 0.5, kd = 0.03, scale = 0.009765625, cart = 1 }'


def ecp_record(path: Path, *, column: int, kind: str) -> Record:
    """Read one encoder of a raw ECP export, in counts, with the input's sign reversed."""
    lines = [line.strip(" [];\n") for line in path.read_text().splitlines()]
    rows = np.array([line.split() for line in lines if line and line[0].isdigit()], dtype=float)
    # Stamps are rounded to a millisecond; the clock itself is even.
    t = np.asarray(np.polyval(np.polyfit(rows[:, 0], rows[:, 1], 1), rows[:, 0]), dtype=np.float64)
    return Record(
        id=path.stem,
        kind="step" if kind == "step" else "decay",
        t=t,
        u=-rows[:, -1] if kind == "step" else None,
        y=rows[:, column][None],
        carts=(1,),
        free=(1,),
        resolution=np.array([1.0]),
    )


def write_two_cart_submission(folder: Path, data: Path, *, steps: tuple[int, ...]) -> Path:
    """Write a submission with runs of single carts, the given two-cart steps and the PID run."""
    experiments = [
        _experiment(f"alone-1-{i}", "step", f"DOF1_en1_input1_test{i}.csv", "carts = [1]")
        for i in range(1, 6)
    ]
    experiments += [
        _experiment(f"alone-2-{i}", "decay", f"DOF1_en2_manual2_test{i}.csv", "carts = [2]")
        for i in range(1, 6)
    ]
    experiments += [
        _experiment(f"both-{i}", "step", f"DOF2_en12_input1_test{i}.csv") for i in steps
    ]
    experiments.append(
        _experiment(
            "pid", "closed_loop", "closed_loop_pid.csv", f"controlled_cart = 1\ncontroller = {PID}"
        )
    )
    text = """version = 1
title = "Two carts, real data"
[system]
carts = 2
springs = [true, true, false]
[design]
cart = 1
reference = 1000.0
input_limit = 4.884
"""
    return _write(folder, data, text, experiments)


def write_one_cart_submission(folder: Path, data: Path) -> Path:
    """Write a submission with the five steps of cart 1, with cart 2 held."""
    experiments = [
        _experiment(f"step-{i}", "step", f"DOF1_en1_input1_test{i}.csv") for i in range(1, 6)
    ]
    text = 'version = 1\ntitle = "One cart, real data"\n[system]\ncarts = 1\n'
    return _write(folder, data, text, experiments)


def _experiment(name: str, kind: str, file: str, more: str = "") -> tuple[str, str]:
    lines = f'[[experiments]]\nid = "{name}"\nkind = "{kind}"\nfile = "data/{file}"\n{more}\n'
    return file, lines


def _write(folder: Path, data: Path, text: str, experiments: list[tuple[str, str]]) -> Path:
    (folder / "data").mkdir(parents=True)
    for file, lines in experiments:
        shutil.copyfile(data / "ecp210-ucsd" / file, folder / "data" / file)
        text += lines
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    return folder
