"""The lock files agree with pyproject.toml, and contain no address."""

import re
import tomllib

import pytest
from packaging.requirements import Requirement

from tests.helpers.places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
AGAIN = "run the two commands of CONTRIBUTING.md, Dependencies"


def _pinned(name: str) -> dict[str, tuple[str, int]]:
    """Return the version of each package and the number of its hashes."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ")
    found = {}
    for line in text.splitlines():
        match = re.fullmatch(r"([a-z0-9-]+)(?:\[\S+\])?==(\S+)([^#]*)", line)
        assert match, line
        found[match[1]] = match[2], len(re.findall(r" --hash=sha256:[0-9a-f]{64}\b", match[3]))
    return found


def _asked(extra: str) -> list[Requirement]:
    """Return the requirements of an extra, including those of the extras that it names."""
    needed = []
    for one in map(Requirement, PROJECT["optional-dependencies"][extra]):
        needed += [n for e in one.extras for n in _asked(e)] if one.name == "cartlab" else [one]
    return needed


@pytest.mark.parametrize(
    ("lock", "extras"), [("requirements.lock", []), ("requirements-dev.lock", ["courses", "dev"])]
)
def test_a_lock_has_a_version_that_the_project_allows(lock, extras):
    """Each lock file has, for each dependency, a version that pyproject.toml allows."""
    pinned = _pinned(lock)
    asked = [*map(Requirement, PROJECT["dependencies"]), *(n for e in extras for n in _asked(e))]

    names = {one.name: one.name.lower().replace("_", "-") for one in asked}
    lacking = [one.name for one in asked if names[one.name] not in pinned]
    outside = [str(o) for o in asked if o.name not in lacking
               and not o.specifier.contains(pinned[names[o.name]][0])]  # fmt: skip

    assert (lacking, outside) == ([], []), AGAIN
    assert all(hashes > 0 for _, hashes in pinned.values())


def test_both_locks_have_the_same_versions_and_no_address():
    """Users and developers get the same versions, and no lock file names a package index."""
    users, developers = _pinned("requirements.lock"), _pinned("requirements-dev.lock")
    assert {name: developers.get(name) for name in users} == users, AGAIN
    for name in ("requirements.lock", "requirements-dev.lock"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert not re.search(r"://|--(?!hash=)", text), name
