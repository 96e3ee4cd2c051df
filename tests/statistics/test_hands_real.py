"""In recordings of a real rig, exactly those touches are found that a plot shows."""

import numpy as np
import pytest

from pipeline.estimation.force_balance import find_interventions
from pipeline.submission import load_submission
from pipeline.workflow import analyse

pytestmark = pytest.mark.slow

# When somebody moves the free cart, read from plots of all 17 files. Nobody does in the steps and
# in the last five files, which are closed-loop runs.
SEEN = {
    "07-Feb-2025_10_34_21": [(0.0, 0.55)],  # held while the encoders were zeroed, then released
    "07-Feb-2025_11_28_21": [(5.45, 5.6)],  # begins in motion; the cart is pulled out and released
    "14-Feb-2025_09_22_43": [(1.18, 1.32), (4.8, 4.93), (9.73, 9.95)],  # three plucks
    "14-Feb-2025_09_44_21": [(0.73, 1.2), (1.55, 1.68)],  # two plucks, the first stopped
}
TO = 0.16  # s; in a plot one cannot see how long a stopping hand stays on the cart
ALONE = ("09_26", "09_29", "09_35", "21-Feb-2025_09")  # cart 1 moves; cart 2 is held by hand


@pytest.fixture(scope="module")
def rig(real_data, tmp_path_factory):
    """Return the analysis of a submission with the 17 files."""
    folder = tmp_path_factory.mktemp("rig")
    lines = ["version = 1", 'title = "Two carts"', "[system]", "carts = 2",
             "springs = [true, true, false]"]  # fmt: skip
    for file in sorted((real_data / "ecp210-2025").glob("*.txt")):
        (folder / file.name).write_bytes(file.read_bytes())
        kind, carts = "step", [1, 2]
        if file.stem in SEEN:
            kind, carts = "decay", [2]
        elif any(day in file.stem for day in ALONE):
            carts = [1]
        elif file.stem.startswith("21-Feb"):
            kind = "closed_loop"
        lines += ["[[experiments]]", f'id = "{file.stem}"', f'kind = "{kind}"',
                  f'file = "{file.name}"', f"carts = {carts}"]  # fmt: skip
        if kind == "closed_loop":
            lines += ["controlled_cart = 1", "reference = 1000.0"]
    (folder / "submission.toml").write_text("\n".join(lines), encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def test_hands_are_found_where_a_person_sees_them(rig):
    """The seven interventions by hand in four files are found where the plots show them."""
    assert len(rig.records) == 17
    found: dict[str, list[tuple[float, float]]] = {}
    for one in find_interventions(rig.records):
        assert one.cart == 2
        found.setdefault(one.experiment, []).append((one.start, one.end))

    assert found.keys() == SEEN.keys()
    for name, seen in SEEN.items():
        np.testing.assert_allclose(found[name], seen, atol=TO)


def test_three_plucks_give_three_decays(rig):
    """Three plucks in one recording are three decays, whose frequencies agree within 1 %."""
    decays = [d for d in rig.log_decrements if d.experiment == "14-Feb-2025_09_22_43"]

    assert [decay.number for decay in decays] == [1, 2, 3]
    np.testing.assert_allclose([d.omega_n for d in decays], decays[0].omega_n, rtol=0.01)
    assert all(1.3 < d.release < 1.6 or 4.9 < d.release < 5.2 or d.release > 9.9 for d in decays)


def test_a_held_cart_that_moved_fails_a_check(rig):
    """A check reports a decay in which the held cart moved by 7 % of the other cart's motion."""
    held = [check for check in rig.failed_checks if check.kind == "held"]

    assert [check.about for check in held] == ["14-Feb-2025_09_44_21.cart_1"]
    assert held[0].value == pytest.approx(0.075, abs=0.005)
