"""Without scripts, the instructor's pages make exercises, pictures, solutions and rubrics."""

import json
import re
from collections.abc import Iterator
from html import unescape
from urllib.parse import urlencode

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.desk.app import DeskServer
from pipeline.desk.exercises import check_exercise
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from tests.helpers.desks import Visitor, a_submission
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("all_work_here")
FRICTION = {"effect": "coulomb_friction", "coulomb_friction.place": "2"}


@pytest.fixture(scope="module")
def visitor() -> Iterator[Visitor]:
    """Return a visitor at a desk that draws and writes everything in another process."""
    with DeskServer() as server:
        yield Visitor.of(server.url)


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
            found = check_exercise(
                {"preset": preset},
                [{"key": effect.key, "place": "", "sizes": {}}],
                progress=print,
            )
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
    typed = force("throne-2dof", **(before | {"value": "0.004"}), slide="0")
    assert typed["value"] == "0.004"
    assert 10 ** float(typed["slide"]) == pytest.approx(0.004 / float(usual), rel=0.02)
    other = force("throne-1dof", **before, slide="0")["value"]
    assert other == force("throne-1dof")["value"] != usual


@pytest.mark.slow
@pytest.mark.sample
def test_a_class_equals_what_simulate_writes(visitor, tmp_path):
    """A class of two folders has the same bytes as the class that `cartlab simulate` writes.

    No folder names the hidden effect.
    """
    page = shown(visitor, preset="throne-1dof", effect="coulomb_friction")
    (told,) = re.findall(r"<li>(coulomb_friction on cart 1.*?)</li>", page)
    force = re.search(r'name="coulomb_friction.force.value"[^>]* value="([^"]+)"', page)
    assert force is not None
    out = tmp_path / "class"
    answer = visitor.post(
        "/exercises/make",
        preset="throne-1dof",
        out=str(out),
        folders="2",
        seed="5",
        effect="coulomb_friction",
    )
    assert answer.status == 303
    made = unescape(wait_for(visitor, answer.headers["location"]))
    assert "2 exercises are ready." in made
    assert re.findall(r'<th scope="row">(\w+)</th><td>(\d+)</td>', made) == [("1", "5"), ("2", "6")]
    assert told in made
    kinds = re.findall(r"<figcaption>([\w ]+): ", made)
    assert len(kinds) == len(set(kinds)) >= 3
    assert made.count("<polyline") >= len(kinds)
    assert "submission.toml" in made
    assert f'href="/exercises/made?{urlencode({"out": out})}"' in unescape(visitor.get("/").text)
    assert [folder.name for folder in sorted(out.iterdir())] == ["1", "2"]
    command = ["simulate", "--preset", "throne-1dof", "--seed", "6", "--out", str(tmp_path / "b")]
    hide = f"coulomb_friction:cart=1,force={force[1]}"
    assert CliRunner().invoke(app, [*command, "--hide", hide]).exit_code == 0
    for path in (tmp_path / "b").rglob("*.*"):
        made = (out / "2" / path.relative_to(tmp_path / "b")).read_bytes()
        assert made == path.read_bytes()
        assert b"friction" not in made
    assert force[1] in told
    sent = {"preset": "throne-1dof", "out": str(out), "folders": "0", "seed": "7"}
    again = visitor.post("/exercises/make", **sent, effect="coulomb_friction")
    assert again.status == 422
    text = unescape(again.text)
    assert f'id="out-wrong">{out}: is not empty; choose a new folder</p>' in text
    assert 'id="folders-wrong">folders: expected a whole number from 1 to 500' in text
    assert "--out" not in text
    assert f'id="out" value="{out}"' in text
    assert 'id="seed" value="7"' in text
    assert 'name="effect" value="coulomb_friction" checked' in text


def test_a_custom_chain_is_used_or_its_error_named(visitor):
    """A custom chain makes a bench; an error in it is named, and nothing is drawn."""
    chain = {"preset": "", "m": "2e-4 3e-4", "c": "5e-4, 5e-4", "k": "0 0.1 0.05"}
    page = shown(visitor, **chain, effect="input_delay")
    assert "input_delay: delay" in page
    assert "custom chain: m needs numbers" in shown(visitor, **(chain | {"m": "2e-4 heavy"}))
    assert "custom chain: chain: m must be positive" in shown(visitor, **(chain | {"m": "0 1e-4"}))
    wrong = FRICTION | {"coulomb_friction.force.value": "-1"}
    assert "force must be at least 0" in shown(visitor, preset="throne-2dof", **wrong)
    assert visitor.post("/exercises/make", **wrong, out="x", folders="1", seed="0").status == 422


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
    folder = a_submission(tmp_path / "reference")
    with DeskServer(folder=folder) as server:
        visitor = Visitor.of(server.url)
        assert visitor.get("/solution/0/solution.html").status == 404
        assert visitor.post("/solution/0/make").status == 303
        assert "Make it again" in wait_for(visitor, "/solution/0/")
        assert visitor.get("/solution/0/solution.html").status == 200
        values = json.loads(visitor.get("/solution/0/solution.json").body)
    assert values["schema"] == "cartlab-solution/1"


@pytest.mark.parametrize("folders", ["00000000000199999", "0" * 11 + "1" * 5000, "0", "-1", "²"])
def test_the_number_of_folders_must_be_a_plain_number(visitor, tmp_path, folders):
    """The number of folders must be a plain number up to the limit; anything else is refused."""
    out = tmp_path / "class"
    sent = {"preset": "throne-1dof", "out": str(out), "seed": "0", "folders": folders}
    assert visitor.post("/exercises/make", **sent).status == 422
    assert not out.exists()


@pytest.mark.parametrize("typed", ["~nosuch/x", "", "a\x00b", "a" * 300, "a/" * 5000])
def test_an_impossible_path_is_refused(visitor, typed):
    """Every form refuses a path that cannot exist, such as `~` of an unknown user."""
    sent = {"preset": "throne-1dof", "folders": "1", "seed": "0"}
    assert visitor.post("/open", folder=typed).status == 422
    assert visitor.post("/exercises/make", out=typed, **sent).status == 422
    assert visitor.get(f"/exercises/made?{urlencode({'out': typed})}").status == 422
