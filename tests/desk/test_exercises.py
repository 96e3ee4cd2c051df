"""Without scripts, the instructor's pages make exercises, pictures, solutions and rubrics."""

import json
import re
from collections.abc import Iterator
from html import unescape
from urllib.parse import urlencode

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.desk.exercises import check_exercise
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from tests.helpers.desks import Visitor, a_submission, at_desk
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("all_work_here")
FRICTION = {"effect": "coulomb_friction", "coulomb_friction.place": "2"}


@pytest.fixture(scope="module")
def visitor() -> Iterator[Visitor]:
    """Return a visitor at a desk."""
    with at_desk() as visitor:
        yield visitor


def shown(visitor: Visitor, **sent: str) -> str:
    """Return the page of exercises with a form filled in."""
    answer = visitor.get(f"/exercises/?{urlencode(sent)}")
    assert answer.status == 200
    return unescape(answer.text)


def wait_for(visitor: Visitor, address: str) -> str:
    """Return the page after a long task has ended."""
    until(lambda: 'http-equiv="refresh"' not in visitor.get(address).text)
    return visitor.get(address).text


# ------------------------------------------------------------------------------- exercises


def test_every_effect_has_valid_sizes_on_its_slider():
    """For every effect on each preset, the form's values are accepted by `simulate --hide`."""
    for preset, chain in PRESETS.items():
        for effect in CATALOGUE:
            if chain.n < effect.fewest_carts or (effect.between_carts and chain.n < 2):
                continue
            chosen = [{"key": effect.key, "place": "", "sizes": {}}]
            found = check_exercise({"preset": preset}, chosen, progress=print)
            assert (found["wrong"], len(found["sentences"])) == ("", 1)
            assert all(p["slide"] == "0" for p in found["effects"][0]["parameters"])


def test_a_moved_slider_or_a_typed_number_counts():
    """A typed size is used; without a typed size, the slider counts if it was moved."""

    def force(preset: str, **size: str) -> dict[str, str]:
        chosen = [{"key": "coulomb_friction", "place": "1", "sizes": {"force": size}}]
        found = check_exercise({"preset": preset}, chosen, progress=print)
        return found["effects"][0]["parameters"][0]

    usual = force("throne-2dof")["value"]
    before = {"value": usual, "usual": usual, "was": "0"}
    assert float(force("throne-2dof", **before, slide="-1")["value"]) == pytest.approx(
        float(usual) / 10, rel=0.01
    )
    typed = force("throne-2dof", **(before | {"value": "0,004"}), slide="0")
    assert typed["value"] == "0.004"
    assert 10 ** float(typed["slide"]) == pytest.approx(0.004 / float(usual), rel=0.02)
    other = force("throne-1dof", **before, slide="0")["value"]
    assert other == force("throne-1dof")["value"] != usual


@pytest.mark.slow
def test_each_team_gets_a_bench_of_its_own(visitor, tmp_path):
    """With a percentage, the answer key beside the folder has another bench for each exercise."""
    out = tmp_path / "teams"
    fields = {"preset": "throne-1dof", "out": str(out), "folders": "2", "seed": "0", **FRICTION}
    fields["coulomb_friction.place"] = "1"
    refused = visitor.post("/exercises/make", **fields, vary="60")
    assert refused.status == 422
    assert 'id="vary-wrong"' in refused.text
    visitor.post("/exercises/make", **fields, vary="20")
    page = wait_for(visitor, f"/exercises/made?{urlencode({'out': out})}")
    key = tmp_path / "teams-key.json"
    assert str(key) in page
    teams = json.loads(key.read_text(encoding="utf-8"))["teams"]
    assert sorted(teams) == ["1", "2"]
    assert teams["1"]["model"] != teams["2"]["model"]
    assert "throne" not in "".join(p.read_text(encoding="utf-8") for p in out.rglob("*.toml"))


@pytest.mark.slow
@pytest.mark.sample
def test_a_class_equals_what_simulate_writes(visitor, tmp_path):
    """A class of two folders has the same bytes as the class that `cartlab simulate` writes.

    No folder names the hidden effect, and no folder is written twice.
    """
    page = shown(visitor, preset="throne-1dof", effect="coulomb_friction")
    force = re.search(r'name="coulomb_friction.force.value"[^>]* value="([^"]+)"', page)
    assert force is not None
    out = tmp_path / "class"
    sent = {"preset": "throne-1dof", "out": str(out), "effect": "coulomb_friction"}
    answer = visitor.post("/exercises/make", **sent, folders="2", seed="5")
    assert answer.status == 303
    made = unescape(wait_for(visitor, answer.headers["location"]))
    assert re.findall(r'<th scope="row">(\w+)</th><td>(\d+)</td>', made) == [("1", "5"), ("2", "6")]
    assert force[1] in made
    kinds = re.findall(r"<figcaption>([\w ]+): ", made)
    assert len(kinds) == len(set(kinds)) >= 3
    assert made.count("<polyline") >= len(kinds)
    assert f'href="/exercises/made?{urlencode({"out": out})}"' in unescape(visitor.get("/").text)
    assert [folder.name for folder in sorted(out.iterdir())] == ["1", "2"]
    command = ["simulate", "--preset", "throne-1dof", "--seed", "6", "--out", str(tmp_path / "b")]
    hide = f"coulomb_friction:cart=1,force={force[1]}"
    assert CliRunner().invoke(app, [*command, "--hide", hide]).exit_code == 0
    for path in (tmp_path / "b").rglob("*.*"):
        made = (out / "2" / path.relative_to(tmp_path / "b")).read_bytes()
        assert made == path.read_bytes()
        assert b"friction" not in made
    again = visitor.post("/exercises/make", **sent, folders="0", seed="7")
    assert (again.status, again.wrong_fields) == (422, {"out", "folders"})
    assert (again.value("out"), again.value("seed")) == (str(out), "7")
    assert 'name="effect" value="coulomb_friction" checked' in again.text


def test_a_custom_chain_is_used_or_its_error_named(visitor):
    """A custom chain makes a bench; an error in it is named, and nothing is drawn."""
    chain = {"preset": "", "m": "2e-4 3e-4", "c": "5e-4, 5e-4", "k": "0 0.1 0.05"}
    assert "/exercises/picture" in shown(visitor, **chain, effect="input_delay")
    for masses, said in (("2e-4 heavy", "m needs"), ("0 1e-4", "m must")):
        page = shown(visitor, **(chain | {"m": masses}))
        assert (said in page, "/exercises/picture" in page) == (True, False)
        assert 'id="chain-wrong"' in page


def test_a_wrong_number_of_an_effect_is_refused_at_its_field(visitor):
    """A size that is refused has its reason at its field, also if it is wrong beside another."""
    stiction = {"effect": "stiction", "stiction.velocity.value": "0.1"}
    weak = {"stiction.force.value": "2e-3", "stiction.static_force.value": "1e-3"}
    for typed, refused in (
        ({**FRICTION, "coulomb_friction.force.value": "-1"}, {"coulomb_friction.force"}),
        ({**FRICTION, "coulomb_friction.force.value": "x"}, {"coulomb_friction.force"}),
        ({**stiction, **weak}, {"stiction.force", "stiction.static_force"}),
        ({**stiction, "stiction.velocity.value": "-1"}, {"stiction.velocity"}),
    ):
        page = shown(visitor, preset="throne-2dof", **typed)
        assert set(re.findall(r'aria-describedby="([\w.]+)-wrong"', page)) == refused
        assert len(re.findall(r'role="alert" id="[\w.]+-wrong"', page)) == len(refused)
        assert ("--hide" in page, "/exercises/picture" in page) == (False, False)
        make = {"out": "x", "folders": "1", "seed": "0"}
        assert visitor.post("/exercises/make", **typed, **make).status == 422


def test_two_effects_that_exclude_each_other_are_named_together(visitor):
    """If no field is wrong alone, the reason is shown above the effects."""
    chosen = [{"key": key, "place": "1", "sizes": {}} for key in ("coulomb_friction", "stiction")]
    found = check_exercise({"preset": "throne-2dof"}, chosen, progress=print)
    assert (found["about"], found["sentences"]) == ("effects", [])
    assert not any(p["wrong"] for one in found["effects"] for p in one["parameters"])


def test_a_picture_is_inert(visitor):
    """The picture of an effect is an SVG without scripts, and a forged address is refused."""
    (address,) = re.findall(r'src="(/exercises/picture[^"]+)"', shown(visitor, **FRICTION))
    drawn = visitor.get(address)
    assert drawn.headers["content-type"] == "image/svg+xml"
    assert "script" not in drawn.headers["content-security-policy"]
    assert "sandbox" in drawn.headers["content-security-policy"]
    assert drawn.body.startswith(b"<svg ")
    forged = urlencode({"preset": "throne-2dof", "hide": "coulomb_friction:force=<script>"})
    assert visitor.get(f"/exercises/picture.svg?{forged}").status == 422


def test_a_solution_is_made_and_shown(tmp_path):
    """The desk makes a solution, shows its page, and gives the expected values as JSON."""
    with at_desk(a_submission(tmp_path / "reference")) as visitor:
        assert visitor.get("/solution/0/solution.html").status == 404
        assert visitor.post("/solution/0/make").status == 303
        wait_for(visitor, "/solution/0/")
        assert visitor.get("/solution/0/solution.html").status == 200
        values = json.loads(visitor.get("/solution/0/solution.json").body)
    assert values["schema"] == "cartlab-solution/1"


def test_an_impossible_path_or_number_is_refused(visitor, tmp_path):
    """Every form refuses a path that cannot exist, and a number of folders that is not plain."""
    sent = {"preset": "throne-1dof", "seed": "0"}
    for typed in ("~nosuch/x", "", "a\x00b", "a" * 300, "a/" * 5000):
        assert visitor.post("/open", folder=typed).status == 422
        assert visitor.post("/exercises/make", out=typed, folders="1", **sent).status == 422
        assert visitor.get(f"/exercises/made?{urlencode({'out': typed})}").status == 422
    out = tmp_path / "class"
    for folders in ("00000000000199999", "0" * 11 + "1" * 5000, "0", "-1", "²"):
        answer = visitor.post("/exercises/make", out=str(out), folders=folders, **sent)
        assert answer.status == 422, folders[:20]
    assert not out.exists()
