"""`cartlab doctor` describes this installation correctly."""

import json
import os
import re
from importlib.metadata import version

import pytest

from tests.helpers.commandline import cartlab, cartlab_here


def test_all_that_is_needed_works_here():
    """`doctor` shows the installed version of each needed package; its text and JSON agree."""
    told, text = cartlab_here("doctor", "--json"), cartlab_here("doctor")

    assert (told.returncode, text.returncode) == (0, 0), told.stdout
    health = json.loads(told.stdout)
    assert len(health["needed"]) > 20
    for package in health["needed"]:
        assert package["found"] == version(package["name"])
        assert package["problem"] == ""
        assert f"{package['name']} {package['found']}" in text.stdout
    assert set(health["programs"]) == {"C compiler", "browser"}
    assert all(path == "" or os.access(path, os.X_OK) for path in health["programs"].values())
    assert os.access(health["compiled"], os.W_OK)


@pytest.mark.slow
@pytest.mark.sample
def test_a_package_that_does_not_load_is_named(tmp_path, monkeypatch):
    """If a package cannot be loaded, `doctor` names it with its error and ends with status 1."""
    (tmp_path / "yaml.py").write_text("raise ImportError('its library is gone')")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)

    done = cartlab("doctor")

    assert done.returncode == 1
    assert re.search("pyyaml: .*ImportError: .*gone", done.stdout)
