"""The catalogue of effects is printed as text and JSON, and shown as a page with pictures."""

import json
import re

import pytest

from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.report.effect_texts import catalogue_data, catalogue_text
from pipeline.report.effects import build_gallery, render_effects
from tests.helpers.commandline import cartlab_here


def test_the_list_has_every_effect_with_its_parameters():
    """Each effect is listed with place, parameters, units, fingerprint, experiment and source."""
    text = " ".join(catalogue_text(CATALOGUE).split())

    for effect in CATALOGUE:
        for part in (effect.key, effect.sentence, effect.fingerprint, effect.deciding_run):
            assert part in text
        assert effect.reference in text
        assert all(f"{p.name} {p.symbol}" in text for p in effect.parameters)
    assert "coefficient q [V s²/cm²]" in text.replace("\u00a0", " ")


def test_json_is_for_programs():
    """`cartlab effects NAME --json` prints one entry as data."""
    done = cartlab_here("effects", "stiction", "--json")

    (entry,) = json.loads(done.stdout)
    assert entry == catalogue_data([find_effect("stiction")])[0]
    assert entry["where"] == "cart"
    assert [p["name"] for p in entry["parameters"]] == ["force", "static_force", "velocity"]
    assert entry["parameters"][2]["unit"] == "cm/s"
    assert [e["effect"] for e in catalogue_data(CATALOGUE)] == [e.key for e in CATALOGUE]


def test_a_misspelt_effect_gives_the_nearest_name():
    """If an effect's name is misspelt, the error gives the nearest name and the status is 2."""
    done = cartlab_here("effects", "back_lash")

    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"cartlab: .*'back_lash'.*'backlash'.*\n", done.stderr)


def test_a_wrong_option_of_simulate_prints_one_line(tmp_path):
    """A wrong option of `simulate` ends with status 2 and one line, and nothing is written."""
    for arguments, expected in (
        (("--preset", "throne-1dof", "--hide", "friction:force=1"), "no effect 'friction'"),
        (("--model", tmp_path / "no.json"), "no.json: cannot be read (No such file or directory)"),
        ((), "either --preset or --model"),
    ):
        done = cartlab_here("simulate", *arguments, "--out", tmp_path / "out")

        assert done.returncode == 2
        assert expected in done.stderr
        assert len(done.stderr.splitlines()) == 1
        assert not (tmp_path / "out").exists()


# one effect for each kind of picture, and the effect that scales the readings
FIRST = {effect.axis: effect for effect in reversed(CATALOGUE)}
PICTURED = [*FIRST.values(), find_effect("sensor_gain")]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Write a page with a few effects."""
    out = tmp_path_factory.mktemp("gallery")
    render_effects(PICTURED, out)
    return out


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_every_effect_has_a_picture(effect, tmp_path):
    """Every effect of the catalogue has a picture for parameters of usual size."""
    render_effects([effect], tmp_path)
    assert (tmp_path / "figures" / f"{effect.key}.svg").is_file()


def test_the_page_loads_nothing(page):
    """The page is one file that loads nothing and has a picture of each effect."""
    html = (page / "effects.html").read_text(encoding="utf-8")

    assert html.count("<svg ") == len(PICTURED)
    assert html.count("<script>") == 1
    assert not re.search(r'(src|href)="(?!#|data:)', html)
    for effect in PICTURED:
        assert f'id="{effect.key}"' in html
        assert (page / "figures" / f"{effect.key}.svg").is_file()


def test_the_page_is_the_same_every_time(page, tmp_path):
    """The same catalogue gives the same bytes."""
    chosen = PICTURED[:2]

    render_effects(chosen, tmp_path / "again")

    for effect in chosen:
        name = f"figures/{effect.key}.svg"
        assert (tmp_path / "again" / name).read_bytes() == (page / name).read_bytes()


@pytest.mark.parametrize("key", ["coulomb_friction", "sensor_gain", "input_delay"])
def test_every_entry_shows_how_to_hide_it(key):
    """The command under each picture is valid for `cartlab simulate`."""
    from pipeline.simulated.hidden import prepare_bench

    document = build_gallery([find_effect(key)])

    (command,) = re.findall(r"--hide (\S+)", str(document))
    (term,) = prepare_bench(preset="throne-2dof", hide=[command]).effects
    assert term.effect.key == key
