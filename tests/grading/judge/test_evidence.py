"""Bad recordings cost in proportion to what was asked for; numbers need usable recordings."""

import re
import shutil
from functools import cache
from pathlib import Path

import pytest

from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric import FlagCost, Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.grading_students import criterion
from tests.helpers.spoilt import files, spoil, times


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a submission for two carts: three decays of each cart, steps, dwells and a loop."""
    path = tmp_path_factory.mktemp("evidence") / "team-07"
    write_submission(path, "throne-2dof", seed=41, compact=True, reported=True)
    return path


@cache
def rubric(data_problem: float) -> Rubric:
    """Return the shipped rubric, with another least cost of a bad recording."""
    shipped = load_rubric(Path("throne-2dof"))
    flags = shipped.flags.model_copy(update={"data_problem": FlagCost(least=data_problem)})
    return shipped.model_copy(update={"flags": flags, "step": 0.01})


def grade(path: Path, *, data_problem: float = 0.0) -> Grade:
    return grade_submission(
        load_submission(path), rubric=rubric(data_problem), name=path.name
    ).grade


def with_decays(folder: Path, path: Path, labels: dict[int, int]) -> Path:
    """Return a copy in which the decays of some carts are stated to be those of others."""
    shutil.copytree(folder, path)
    toml = path / "submission.toml"
    head, *blocks = re.split(r"(?=\[\[experiments\]\])", toml.read_text("utf-8"))
    for i, block in enumerate(blocks):
        cart = re.search(r"^carts = \[(\d)\]", block, re.MULTILINE)
        if 'kind = "decay"' in block and cart and int(cart[1]) in labels:
            blocks[i] = block.replace(cart[0], f"carts = [{labels[int(cart[1])]}]")
    toml.write_text(head + "".join(blocks), "utf-8", newline="\n")
    return path


dead = times(0.0, "x2")  # the encoder of cart 2 reads zero throughout a recording


def test_numbers_without_a_usable_recording_are_not_judged(folder, tmp_path):
    """If all decays are labelled with the wrong cart, the numbers from them earn nothing.

    The fit to the other recordings knows these numbers, so they seemed right. Each message has
    each fault once. The points are the decays' share of what is required: two of five kinds.
    """
    found = grade(with_decays(folder, tmp_path / "team-07", {1: 2, 2: 1}))
    decays, data = criterion(found, "initial-decays"), criterion(found, "data")
    assert (decays.outcome, decays.points) == ("skip", 0)
    assert "omega_1, zeta_1: " in decays.message
    assert data.points == 0.6
    assert data.message.count("cart 1 moves") == data.message.count("cart 2 moves") == 1
    assert "?." not in data.message
    lost = {c.id for c in found.criteria if c.points < c.out_of}
    assert lost == {"initial-decays", "data"}


def test_numbers_of_the_other_cart_are_still_judged(folder, tmp_path):
    """If only the decays of cart 1 are unusable, the numbers of cart 2 earn their half."""
    found = grade(with_decays(folder, tmp_path / "team-07", {1: 2}))
    decays = criterion(found, "initial-decays")
    assert (decays.outcome, decays.points) == ("partial", 1)
    assert "omega_1, zeta_1: " in decays.message
    assert "omega_2" not in decays.message
    asked = next(c for c in rubric(0.0).criteria if c.id == decays.id)
    assert asked.message not in decays.message  # the rubric's advice is for wrong numbers


@pytest.mark.parametrize("data_problem", [0.0, 0.25])
def test_a_dead_channel_costs_less_than_six_wrong_labels(folder, tmp_path, data_problem):
    """One dead channel costs the least that the rubric states; six mislabelled decays cost more."""
    shutil.copytree(folder, tmp_path / "one")
    spoil(files(tmp_path / "one", "sine-05"), dead)
    one = grade(tmp_path / "one", data_problem=data_problem)
    six = grade(with_decays(folder, tmp_path / "six", {1: 2, 2: 1}), data_problem=data_problem)
    assert criterion(one, "data").points == 1 - data_problem
    assert "cart 2" in criterion(one, "data").message
    assert criterion(six, "data").points == 0.6
    assert six.points < one.points - 1


def test_a_channel_that_is_dead_in_all_steps_costs_the_steps(folder, tmp_path):
    """An encoder that is dead in all steps costs one of five kinds, and the gains from steps."""
    path = tmp_path / "team-07"
    shutil.copytree(folder, path)
    spoil(files(path, "step"), dead)
    found = grade(path)
    assert criterion(found, "data").points == 0.8
    assert criterion(found, "initial-gains").outcome == "skip"
    assert "K_1, K_2: " in criterion(found, "initial-gains").message
    assert criterion(found, "initial-decays").outcome == "pass"


def test_numbers_without_a_required_recording_are_not_judged(folder, tmp_path):
    """Without any decay, which the rubric requires, the numbers from decays earn nothing."""
    shutil.copytree(folder, tmp_path / "team-07")
    toml = tmp_path / "team-07" / "submission.toml"
    head, *blocks = re.split(r"(?=\[\[experiments\]\])", toml.read_text("utf-8"))
    kept = [block for block in blocks if 'kind = "decay"' not in block]
    assert 'kind = "decay"' not in blocks[-1]  # the tables of reported numbers follow it
    toml.write_text(head + "".join(kept), "utf-8", newline="\n")
    submission = load_submission(toml.parent)
    strict = grade(toml.parent)
    assert criterion(strict, "initial-decays").outcome == "skip"
    assert criterion(strict, "data").points == 1  # what is missing is another criterion's matter
    required = rubric(0.0).required
    others = tuple(runs for runs in required.experiments if runs.kind != "decay")
    update = {"required": required.model_copy(update={"experiments": others})}
    loose = grade_submission(submission, rubric=rubric(0.0).model_copy(update=update), name="t")
    assert criterion(loose.grade, "initial-decays").outcome == "pass"
