"""`fill` finds from steps which springs exist, and marks the others as unsure."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.identify.springs import check_springs, decide_springs, fill_folder
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.resources import EXAMPLES
from pipeline.results import Record
from pipeline.setup import Setup
from pipeline.submission import load_submission
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.places import REAL_DATA

STEP = 0.00227  # cm, one encoder step
MASS, DAMPING, SPRING = 2.5e-4, 1.5e-3, 0.06


def step(k: list[float], *, seconds: float = 8.0) -> Record:
    """Return encoder readings of a step on and off, on a bench with these springs."""
    n = len(k) - 1
    chain = Chain(m=np.full(n, MASS), c=np.full(n, DAMPING), k=np.array(k))
    t = np.arange(0.0, seconds, 0.00884)
    u = np.where((t > 0.3) & (t < seconds / 2), 0.05, 0.0)
    y = np.round(simulate_linear(chain, t, u) / STEP) * STEP
    carts = tuple(range(1, n + 1))
    resolution = np.full(n, STEP)
    return Record(
        id="step", kind="step", t=t, u=u, y=y, carts=carts, free=carts, resolution=resolution
    )


@pytest.mark.parametrize(
    ("k", "present", "not_told"),
    [
        ([SPRING, 0], [True, True], ()),  # for one cart only the sum can be known
        ([SPRING, SPRING, 0], [True, True, False], ()),
        ([2 * SPRING, SPRING / 2, SPRING, 0], [True, True, True, False], ()),
        ([0, SPRING, SPRING], [True, True, True], (1,)),
        ([SPRING, SPRING, SPRING], [True, True, True], (1,)),
        ([0, 2 * SPRING, SPRING, SPRING / 2], [True] * 4, (1,)),
        ([SPRING, SPRING, SPRING / 5], [True] * 3, (1,)),
        ([0, 0], [False, False], ()),
        ([0, SPRING, 0], [False, True, False], ()),
        ([0, SPRING, SPRING, 0], [False, True, True, False], ()),
    ],
)
def test_steps_show_which_wall_springs_there_are(k, present, not_told):
    """Equal gains mean that there is no far spring; if carts do not return, no wall has one."""
    found = decide_springs([step(k)], n=len(k) - 1)
    assert found.present == tuple(present)
    assert found.open == not_told


def test_without_a_step_of_all_carts_both_walls_are_open():
    """Without a step of all carts, or with a short one, both wall springs stay open."""
    assert decide_springs([], n=2).open == (1, 3)
    short = step([0.0, SPRING, SPRING], seconds=0.7)
    assert decide_springs([short], n=2).open == (1, 3)


@pytest.mark.parametrize(
    ("ratio", "stated", "code"),  # stiffness of the far spring, relative to the one before it
    [
        (0.03, True, "no_spring"),
        (0.2, True, ""),
        (0.03, False, ""),
        (0.2, False, "spring"),
    ],
)
def test_static_gains_show_whether_there_is_a_far_spring(ratio, stated, code):
    """K_1 / K_2 - 1 is k_3 / k_2, which contradicts a stated spring only if it is almost zero."""
    one = make_analysis(2).step_gains[0]
    gains = [
        replace(one, cart=cart, gain=K, gain_std=1e-3, interval=None)
        for cart, K in ((1, 1.0 + ratio), (2, 1.0))
    ]
    bench = Setup(springs=(True, True, stated))
    checks = check_springs(None, responses=(), gains=gains, records=(), bench=bench)
    assert [(check.code, check.parameter) for check in checks] == [(code, "k_3")] * bool(code)


def folder_of(data: Path, folder: Path) -> Path:
    """Return a folder with the recordings, but without their descriptions."""
    shutil.copytree(data, folder / "data")
    return folder


def test_fill_marks_what_the_files_do_not_show(tmp_path):
    """`fill` prints open questions and marks them in the file, until a person answers."""
    folder = folder_of(EXAMPLES / "two-cart" / "data", tmp_path / "s")
    done = CliRunner().invoke(app, ["fill", str(folder)], standalone_mode=False)
    text = (folder / "submission.toml").read_text(encoding="utf-8")
    springs, position = (
        next(line for line in text.splitlines() if line.startswith(key))
        for key in ("springs = ", "position = ")
    )
    doubts = tuple(
        line.removeprefix("cartlab: ") for line in done.stderr.splitlines() if "unsure: " in line
    )
    assert fill_folder(folder).doubts == doubts
    asked = dict(doubt.split(": unsure: ") for doubt in doubts)
    assert asked.keys() == {"springs", "position"}
    assert f"# unsure: {asked['springs']}" in springs
    assert "wall-1" in asked["springs"]
    assert f"# unsure: {asked['position']}" in position
    assert "stuck" not in done.stdout  # the cart was held
    settled = text.replace(springs, "springs = [false, true, true]").replace(
        position, 'position = { unit = "cm" }'
    )
    (folder / "submission.toml").write_text(settled, encoding="utf-8")
    assert fill_folder(folder).doubts == ()


@pytest.mark.parametrize(("unit", "said"), [("furlong", "known"), ("count", "decimals")])
def test_fill_prints_a_doubt_about_an_existing_unit(unit, said, tmp_path):
    """If an existing file has a doubtful unit, `fill` prints a message but marks nothing."""
    folder = folder_of(EXAMPLES / "one-cart" / "data", tmp_path / "s")
    text = f'version = 1\n[system]\ncarts = 1\nposition = {{ unit = "{unit}" }}\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    (doubt,) = fill_folder(folder).doubts
    assert doubt.startswith("position: ")
    assert said in doubt
    assert "unsure" not in (folder / "submission.toml").read_text(encoding="utf-8").split("[[")[0]


@pytest.mark.parametrize("factors", [(1, 1, 1, 1), (1, 1, 2, 2)])
def test_fill_is_not_sure_of_springs_if_steps_contradict_each_other(factors, tmp_path):
    """Equal static gains decide nothing if the steps come from several set-ups."""
    (tmp_path / "data").mkdir()
    for i, factor in enumerate(factors):
        record = step([SPRING, SPRING, 0], seconds=8.0 + i)
        y = np.round(record.y / factor / STEP) * STEP
        rows = np.column_stack([record.t, record.input, *y])
        file = tmp_path / "data" / f"step-{i}.csv"
        np.savetxt(file, rows, delimiter=",", header="time,input,x1 [cm],x2 [cm]", comments="")
    doubts = fill_folder(tmp_path).doubts
    assert [doubt.partition(":")[0] for doubt in doubts] == ["springs"] * (len({*factors}) > 1)
    assert load_submission(tmp_path).system.springs == (True, True, False)


@pytest.mark.skipif(not (REAL_DATA / "ecp210-ucsd").is_dir(), reason="no real recordings here")
def test_the_real_rig_has_no_far_spring(tmp_path):
    """From the real rig's files, `fill` finds that it has no far spring, without any doubt."""
    folder = tmp_path / "s"
    (folder / "data").mkdir(parents=True)
    for file in (REAL_DATA / "ecp210-ucsd").glob("DOF*_test?.csv"):
        shutil.copyfile(file, folder / "data" / file.name)
    assert fill_folder(folder).doubts == ()
    assert load_submission(folder).system.springs == (True, True, False)
