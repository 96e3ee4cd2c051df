"""The shipped rubrics are valid; every mistake in a rubric is named with its line."""

import json
from datetime import datetime
from pathlib import Path

import pytest
from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.grading.grade import CODES
from pipeline.grading.rubric import FlagCost, FlagCosts, Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.rubric_text import rubric_dict, rubric_text
from pipeline.resources import RUBRICS

SHIPPED = sorted(RUBRICS.glob("*.toml"))
DUE = [
    ("2026-11-29T23:59:00+01:00", "2026-11-29T23:59:00+01:00"),
    ('"2026-11-29T23:59:00+01:00"', "2026-11-29T23:59:00+01:00"),
    ('"2026-11-29 23:59 -08:00"', "2026-11-29T23:59:00-08:00"),
    ('"2026-11-29 23:59Z"', "2026-11-29T23:59:00+00:00"),
    ("2026-11-29T23:59:00", None),
    ("2026-11-29", None),
    ('"2026-11-29"', None),
    ('"Sunday"', None),
]
GOOD = """\
version = 1

[system]
carts = 2
springs = [false, true, true]
input = { unit = "V" }

[required]
final = ["K_*"]

[[required.experiments]]
kind = "step"

[[criteria]]
id = "gains"
points = 2
check = "final"
parameters = ["K_*"]

[[criteria]]
id = "model"
points = 1.5
check = "state_space"
requires = ["gains"]
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "lab.toml"
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_rubrics_are_valid_and_worth_twenty_points(path):
    """Each shipped rubric loads by path and by name, lists its criteria and gives 20 points."""
    rubric = load_rubric(path)
    assert load_rubric(Path(path.stem)) == rubric
    assert rubric.out_of == 20
    text = rubric_text(rubric)
    assert all(criterion.id in text for criterion in rubric.criteria)
    assert json.loads(json.dumps(rubric_dict(rubric)))["out_of"] == 20


def test_six_rubrics_are_shipped():
    """There is one for each of the paper's systems, one in counts, and two to name effects."""
    names = [path.stem for path in SHIPPED]
    assert names == [
        "effects-1dof",
        "effects-2dof",
        "throne-1dof",
        "throne-2dof",
        "throne-3dof",
        "ucsd-mae171a",
    ]


def test_points_add_up_exactly(tmp_path):
    """Points add up exactly, so that 0.1, 0.2 and 0.3 make 0.6."""
    text = GOOD.replace("points = 2", "points = 0.1").replace("points = 1.5", "points = 0.2")
    text += '\n[[criteria]]\nid = "more"\npoints = 0.3\ncheck = "data"\n'
    assert load_rubric(write(tmp_path, text)).out_of == 0.6


def test_a_pattern_is_written_out(tmp_path):
    """A pattern such as `K_*` is expanded to all gains of the system."""
    plain = rubric_dict(load_rubric(write(tmp_path, GOOD)))
    assert plain["criteria"][0]["parameters"] == ["K_1", "K_2"]
    assert plain["required"]["final"] == ["K_1", "K_2"]


REQUIRED = "[required]"
MISTAKES = [  # what is replaced in the rubric, line of the error, what the error names
    ('unit = "V"', 'unti = "V"', 6, r"system\.input\.unti: .*'unit'"),
    ("points = 2", "pionts = 2", 16, r"criteria\[1\]\.pionts \(gains\): .*"),
    ("points = 2", "points = 0", 16, r"points \(gains\): .* 0"),
    ('check = "final"', 'chek = "final"', 17, r"\.chek \(gains\): .*'check'"),
    ('check = "final"\n', "", 14, r"check \(gains\): "),
    ("points = 2", "points = two", 16, "points .*digits"),
    ("version = 1", "version = 1\nstep = 0.4", 23, r"points \(model\): 1\.5 .* of step"),
    ("version = 1", "version = 1\nstep = 0.125", 2, r"step: 0\.125: "),
    (REQUIRED, f"[flags]\nwrong_state = 1\n{REQUIRED}", 9, "'wrong_state_space'"),
    (REQUIRED, f"[late]\npercent_per_day = 150\n{REQUIRED}", 9, r"late\.percent_per_day: .*150"),
    (REQUIRED, f"[flags]\nmissing = 2\n{REQUIRED}", 9, r"flags\.missing\.least: .*1"),
    ('check = "final"', 'check = "finla"', 17, "'finla'; .*'final'"),
    ('"K_*"]\n\n[[r', '"K_9"]\n\n[[r', 9, r"required\.final: .*'K_9'"),
    ('parameters = ["K_*"]', 'parameters = ["L_*"]', 18, r"'L_\*'"),
    ('kind = "step"', 'kind = "stop"', 12, "kind: .*'step'"),
    ('requires = ["gains"]', 'requires = ["gians"]', 24, "'gians' "),
    ('parameters = ["K_*"]', 'requires = ["model"]', 18, "'model' .*later"),  # no cycles
    ('id = "model"', 'id = "gains"', 21, "'gains' .*before"),
    ("[false, true, true]", "[true]", 5, r"\(wall-1, 1-2, 2-wall\), found 1"),
    ("version = 1", "version = 2", 1, "version: .*1, found 2"),
    ("points = 1.5", "points = 1.5\nfull_percent = 30", 23, "full_percent "),
    ("points = 1.5", "points = 0.333", 22, r"points \(model\): 0.333: "),
    ("version = 1", "version = 1\ntitle = ", 2, "title ="),
]


@pytest.mark.parametrize(("old", "new", "line", "what"), MISTAKES)
def test_a_mistake_is_named_with_its_line(tmp_path, old, new, line, what):
    """An error gives the rubric's file, line and key, and the expected value or the nearest key."""
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ConfigError, match=rf"lab\.toml line {line}: .*{what}"):
        load_rubric(path)


def test_every_mistake_has_its_own_line(tmp_path):
    """If a rubric has three mistakes, the error has three lines in the order of the file."""
    text = GOOD.replace("points = 2", "points = -2").replace("version", "vresion")
    text = text.replace('kind = "step"', 'kind = "stop"')
    with pytest.raises(ConfigError) as caught:
        load_rubric(write(tmp_path, text))
    lines = [int(line.split()[2].rstrip(":")) for line in str(caught.value).splitlines()]
    assert lines == [1, 12, 16]


def test_a_line_that_is_not_toml_is_reported_alone(tmp_path):
    """If a line is not TOML, only the first such line is reported; the rest cannot be judged."""
    text = GOOD.replace("[[criteria]]", "[[criteria]", 1).replace("points = 2", "points = two")
    with pytest.raises(ConfigError, match=r"lab\.toml line 14: ") as caught:
        load_rubric(write(tmp_path, text.replace("version", "vresion")))
    assert len(str(caught.value).splitlines()) == 1


def test_a_misspelt_rubric_gives_the_nearest_shipped_one():
    """If a rubric's name is misspelt, the error suggests the nearest shipped rubric."""
    with pytest.raises(ConfigError, match="'throne-2dof'"):
        load_rubric(Path("throne-2dofs"))


def test_every_flag_may_have_a_cost():
    """Every flag except the one for shared data may have a cost; a person decides on that one."""
    assert {*FlagCosts.model_fields} == {*CODES} - {"shared_data"}
    assert all(load_rubric(path).flags.of("wrong_state_space").least == 0.5 for path in SHIPPED)


def test_a_cost_may_have_a_least_and_a_most():
    """A cost is a number, the least, or a table with the least and the most."""
    plain = load_rubric(Path("throne-2dof")).model_dump(mode="json")
    for cost, expected in (
        (0.25, FlagCost(least=0.25, most=1.0)),
        ({"least": 0.25, "most": 0.5}, FlagCost(least=0.25, most=0.5)),
    ):
        rubric = Rubric.model_validate({**plain, "flags": {"hz_for_rad_s": cost}})
        assert rubric.flags.of("hz_for_rad_s") == expected
        assert rubric.model_dump(mode="json")["flags"]["hz_for_rad_s"] == cost
    with pytest.raises(ValidationError, match="least"):
        FlagCost(least=0.5, most=0.25)


@pytest.mark.parametrize(("typed", "due"), DUE)
def test_a_deadline_needs_date_time_and_offset(tmp_path, typed, due):
    """A deadline may be in quotation marks; a message shows how to write a missing offset."""
    file = tmp_path / "r.toml"
    file.write_text(f"{GOOD}\n[late]\ndue = {typed}\n", encoding="utf-8")
    if due is None:
        with pytest.raises(ConfigError, match=r"line \d+: late\.due: .*2026-"):
            load_rubric(file)
        return
    rubric = load_rubric(file)
    assert rubric.late.due == datetime.fromisoformat(due)
    assert Rubric.model_validate_json(rubric.model_dump_json()) == rubric
