"""A bench that is drawn for one team: only the answer key knows it."""

import stat
import sys

import numpy as np
import pytest

from pipeline import analyse
from pipeline.errors import ConfigError
from pipeline.json_files import json_text
from pipeline.plant.catalogue import find_effect
from pipeline.simulated.answer_key import AnswerKey, changing_key, draw_bench, read_key
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from tests.helpers.commandline import cartlab_here


def simulate(out, secret, *more):
    return cartlab_here(
        "simulate", "--preset", "throne-1dof", "--vary", "20", "--secret", str(secret),
        "--out", str(out), *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    """Two teams with one answer key, whose secret is always the same."""
    folder = tmp_path_factory.mktemp("teams")
    key = AnswerKey(secret="0123456789abcdef", teams={})
    (folder / "key.json").write_text(json_text(key), encoding="utf-8")
    for team in ("a", "b"):
        assert simulate(folder / team, folder / "key.json").returncode == 0
    return folder


def test_teams_get_different_benches_that_their_recordings_show(teams):
    """The report of each team finds the true values of its own bench, and not the other's."""
    key = read_key(teams / "key.json")
    for team, other in (("a", "b"), ("b", "a")):
        for row in analyse(teams / team).results.rows:
            assert row.final is not None
            std = row.final.std or 0.0
            own, theirs = (key.teams[one].parameters[row.name] for one in (team, other))
            assert abs(row.final.value - own) < 5 * std
            assert abs(row.final.value - theirs) > 5 * std


def test_the_files_of_a_team_tell_nothing(teams):
    """No file names the preset, a seed, an author or a value of the key."""
    key = read_key(teams / "key.json")
    text = "".join(
        path.read_text(encoding="utf-8") for path in (teams / "a").rglob("*") if path.is_file()
    )
    for word in ("throne", "seed", "[[authors]]", "s10", key.secret):
        assert word not in text
    assert load_submission(teams / "a").authors == ()
    if sys.platform != "win32":
        assert stat.S_IMODE((teams / "key.json").stat().st_mode) == 0o600


def test_the_same_key_draws_the_same_bench(teams, tmp_path):
    """With the key the files are repeated byte by byte; without it they are not."""
    again, new = tmp_path / "again" / "a", tmp_path / "new" / "a"
    key = (teams / "key.json").read_bytes()
    copy = tmp_path / "copy.json"
    copy.write_bytes(key)
    assert simulate(again, copy).returncode == 0
    assert simulate(new, tmp_path / "other.json").returncode == 0
    for path in (teams / "a").rglob("*.csv"):
        name = path.relative_to(teams / "a")
        assert (again / name).read_bytes() == path.read_bytes()
    swings = [(folder / "data" / "decay-1a.csv").read_bytes() for folder in (again, new)]
    assert swings[0] != swings[1]
    assert copy.read_bytes() == key


def test_another_bench_does_not_replace_the_answers_of_a_team(teams, tmp_path):
    """A folder of the same name with another draw is refused, and the key stays as it is."""
    before = (teams / "key.json").read_bytes()
    again = simulate(tmp_path / "a", teams / "key.json", "--seed", "5")
    assert again.returncode == 2
    assert (teams / "key.json").read_bytes() == before


def test_one_of_several_effects_is_drawn(tmp_path):
    """The key draws the effect; the same key draws it again; both draws of a bench are unlike."""
    options = "coulomb_friction/presliding_friction/input_delay/dead_zone:width=0.1"
    drawn = []
    for again in ("first", "again"):
        secret = tmp_path / f"{again}.json"
        secret.write_text(json_text(AnswerKey(secret="0123456789abcdef", teams={})), "utf-8")
        out = tmp_path / again / "a"
        assert simulate(out, secret, "--hide", options, "--hide", options).returncode == 0
        drawn.append(read_key(secret).teams["a"].model.terms)
    assert json_text(drawn[0]) == json_text(drawn[1])
    assert len({term.effect.family or term.effect.key for term in drawn[0]}) == 2
    seen = [
        prepare_bench(preset="throne-1dof", hide=[options], rng=np.random.default_rng(n)).effects[0]
        for n in range(40)
    ]
    assert len({term.effect.key for term in seen}) == 4
    assert {term.parameters["width"] for term in seen if term.effect.key == "dead_zone"} == {0.1}


@pytest.mark.parametrize("hide", ["input_delay/dead_zon", "dead_zone/", "dead_zone/dead_zone"])
def test_alternatives_are_checked_whichever_is_drawn(hide):
    """An unknown effect among the alternatives, or only effects that are there, are refused."""
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError):
        prepare_bench(preset="throne-1dof", hide=["dead_zone", hide], rng=rng)
    with pytest.raises(ConfigError):
        prepare_bench(preset="throne-1dof", hide=["dead_zone/input_delay"])


def test_drawn_values_fill_the_range():
    """Factors lie within the percentage and use its whole width; no effect changes its sign."""
    hidden = ("stiction:cart=1", "sensor_gain:cart=1,gain=1.1", "end_stop:cart=1,position=-0.8")
    bench = prepare_bench(preset="throne-2dof", hide=hidden)
    rng, seen = np.random.default_rng(3), []
    for _ in range(200):
        own, _ = draw_bench(bench, percent=20, rng=rng)
        present = bench.chain.k > 0
        assert np.all(own.chain.k[~present] == 0)
        seen.append(own.chain.k[present] / bench.chain.k[present])
        for term, usual in zip(own.effects, bench.effects, strict=True):
            values = term.parameters
            if term.effect is find_effect("stiction"):
                assert values["static_force"] >= values["force"]
            if term.effect is find_effect("sensor_gain"):
                assert 1.08 - 1e-12 <= values["gain"] <= 1.12 + 1e-12
            assert np.array_equal(np.sign(term.values), np.sign(usual.values))
    assert 0.8 <= np.min(seen) < 0.81
    assert 1.19 < np.max(seen) <= 1.2


@pytest.mark.parametrize("percent", [0.0, -5.0, 51.0, float("nan")])
def test_an_impossible_percentage_is_refused(percent):
    """A percentage must be above 0 and at most 50."""
    bench = prepare_bench(preset="throne-1dof")
    with pytest.raises(ConfigError, match="--vary"):
        draw_bench(bench, percent=percent, rng=np.random.default_rng(0))


def test_other_files_and_readable_places_are_refused(tmp_path):
    """A file that is no key stays as it is; a key inside the team's folder is refused."""
    notes = tmp_path / "notes.txt"
    notes.write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match="not an answer"), changing_key(notes):
        pass
    assert notes.read_text(encoding="utf-8") == "mine"
    assert simulate(tmp_path / "a", tmp_path / "a" / "key.json").returncode == 2
    assert not (tmp_path / "a").exists()
    alone = cartlab_here("simulate", "--preset", "throne-1dof", "--vary", "5", "--out", "x")
    assert alone.returncode == 2
