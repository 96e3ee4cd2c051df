"""A hostile upload changes nothing outside its folder, and nothing in it is run."""

import os
import re

import pytest

from tests.helpers.desks import at_desk
from tests.helpers.hostile import SECRET, write_hostile
from tests.helpers.places import ROOT

_OURS = re.compile(r"\.turn|data/[^/]+|submission\.toml|notes\.md|\.lock")


def visit(tmp_path, *, every: int, drawn: int, seed: int, step: int = 1) -> int:
    """Upload and open hostile submissions, each in a folder of its own; return their number.

    Only one in `step` of the submissions is used.
    """
    school, rooms = tmp_path / "school", tmp_path / "rooms"
    school.mkdir()
    good = {
        name: (ROOT / "submissions" / "one-cart" / name).read_bytes()
        for name in ("submission.toml", "notes.md", "data/step-1.csv", "data/decay-1a.csv")
    }
    entries = write_hostile(school, good, seed=seed, every=every, drawn=drawn)[::step]
    outside = {p for p in tmp_path.rglob("*") if not p.is_relative_to(school)}
    folders = [rooms / str(i) for i in range(len(entries))]
    for folder in folders:
        folder.mkdir(parents=True)
    with at_desk() as visitor:
        for folder in folders:
            assert visitor.post("/open", folder=str(folder)).status == 303
        for number, entry in enumerate(entries):
            here, path = f"/student/{number}/", school / entry
            files = [path] if path.is_file() else []
            if path.is_dir() and not path.is_symlink():
                files = [p for p in sorted(path.rglob("*")) if _is_plain(p)]
            sent = [(_quoted(f.name), f.read_bytes()) for f in files if _is_plain(f)]
            assert visitor.upload(here + "files", sent).status in (303, 400, 413, 422), entry
            for page in (visitor.get(here), visitor.get(here + "report")):
                assert page.status in (200, 422), entry
                assert SECRET not in page.text
                assert not re.search(
                    r"<(?!/?script src=\"/static/)script|<img|onerror=\S*\(1\)>", page.text
                )
    for i, folder in enumerate(folders):
        found = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()]
        assert all(_OURS.fullmatch(name) for name in found), entries[i]
        assert not any(p.is_symlink() for p in folder.rglob("*"))
    now = {p for p in tmp_path.rglob("*") if not p.is_relative_to(school)}
    assert all(p.is_relative_to(rooms) for p in now - outside)
    return len(entries)


def _is_plain(path) -> bool:
    return path.is_file() and not path.is_symlink() and os.access(path, os.R_OK)


def _quoted(name: str) -> str:
    """Return a name as a browser sends it in a form."""
    plain = name.encode("utf-8", "replace").decode()
    return plain.replace('"', "%22").replace("\r", "%0D").replace("\n", "%0A")


@pytest.mark.parametrize(
    ("drawn", "least"),
    [
        ({"every": 12, "drawn": 6, "seed": 1, "step": 12}, 4),
        pytest.param(
            {"every": 12, "drawn": 6, "seed": 1}, 50, marks=[pytest.mark.slow, pytest.mark.sample]
        ),
        pytest.param({"every": 1, "drawn": 100, "seed": 2}, 200, marks=pytest.mark.slow),
    ],
)
def test_hostile_uploads_reach_nothing(tmp_path, drawn, least):
    """Hostile and spoilt uploads change nothing outside their folder, and no code in them runs."""
    assert visit(tmp_path, **drawn) >= least
