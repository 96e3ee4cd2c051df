"""A fault of the computer costs nobody a grade, because the next run tries again."""

import io
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import HandIn
from pipeline.grading.intake.unpack import HAND_IN, unpack
from pipeline.grading.rubric_file import load_rubric
from tests.helpers.grading_students import copy_step, write_team
from tests.helpers.places import ROOT

RUBRIC = load_rubric(Path("throne-1dof"))
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limits")
_MEMBER = 3_000_000  # bytes in a file that compresses to a tenth of its size


@pytest.fixture(scope="module")
def teams(tmp_path_factory) -> Path:
    """Write two teams that share a step recording, with large files that compress well."""
    folder = tmp_path_factory.mktemp("teams")
    for number in (0, 2):
        write_team(folder / f"team-{number}", number)
        lines = "".join(f"{i / 1000:.3f},{i % 97}\n" for i in range(_MEMBER // 10))
        (folder / f"team-{number}" / "data" / "all.txt").write_text(lines, encoding="utf-8")
    copy_step(folder / "team-0", folder / "team-2")
    return folder


@pytest.fixture(scope="module")
def zips(teams, tmp_path_factory) -> Path:
    """Return the folder in which each of the two teams is a zip file."""
    folder = tmp_path_factory.mktemp("zips")
    for team in teams.iterdir():
        shutil.make_archive(str(folder / team.name), "zip", teams, team.name)
    return folder


@contextmanager
def small_disk(at: Path, *, size: str) -> Iterator[None]:
    """Mount a disk of the given size at a folder; skip the test if mounting is not permitted."""
    at.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(at)]
    if shutil.which("mount") is None or subprocess.run(words, check=False).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        yield
    finally:
        subprocess.run(["umount", str(at)], check=True)


def grade(zips: Path, out: Path) -> subprocess.CompletedProcess[str]:
    """Grade the class in a new process."""
    command = [sys.executable, "-m", "pipeline", "grade", zips, "--rubric", "throne-1dof",
               "--no-figures", "--jobs", "1", "--out", out]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform != "linux", reason="a small disk is made of memory")
def test_a_full_disk_costs_nobody_a_grade(zips, tmp_path):
    """If the disk is full, the message says so, and the next run grades everybody."""
    disk = tmp_path / "disk"
    with small_disk(disk, size="1200k"):
        full = grade(zips, disk / "out")
        assert full.returncode == 1
        assert "space left" in full.stderr
        assert "is full" in full.stderr
        assert "the rubric" not in full.stderr
        subprocess.run(["mount", "-o", "remount,size=60m", disk], check=True)
        again = grade(zips, disk / "out")
        assert again.returncode == 0, again.stderr
        with Gradebook(disk / "out") as book:
            grades = [entry.grade for entry in book.entries()]
    assert [grade.status for grade in grades] == ["graded", "graded"]
    assert all("shared_data" in [flag.code for flag in grade.flags] for grade in grades)


def test_a_file_with_an_impossible_name_is_refused_for_good(tmp_path):
    """If the file system cannot store a member of an archive, the member is refused for good.

    One name is too long; another needs a folder with the name of an existing file. Trying again
    cannot help.
    """
    archive = tmp_path / "odd.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        packed.writestr("a", "a file")
        packed.writestr("a/b", "in it")
        packed.writestr("n" * 300, "too long")
    refused = unpack(archive, tmp_path / "out", limits=HAND_IN)
    assert [len(path.name) for path in refused] == [1, 300]


_STARVED = """
import json, resource, sys
from pathlib import Path
from pipeline.grading.gradings import HandIn
from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.rubric_file import load_rubric

source, scratch, limit, *soft = sys.argv[1:]
task = HandIn(id="team", key="k", sources=(Path(source),))
rubric = load_rubric(Path("throne-1dof"))
which = getattr(resource, limit)
hard = resource.getrlimit(which)[1]

def grade():
    outcome = grade_hand_in(task, rubric=rubric, scratch=Path(scratch))
    return [outcome.settled, outcome.is_disk_full, outcome.reason, outcome.grade]

told = [grade()]
for most in map(int, soft):
    resource.setrlimit(which, (most, hard))
    told.append(grade())
    resource.setrlimit(which, (hard, hard))
print(json.dumps(told))
"""


def starved(source: Path, scratch: Path, limit: str, soft: range) -> list[list]:
    """Grade once without a limit, then once with each limit.

    For each grading, return whether it is final, whether the disk was full, the reason and the
    grade.
    """
    scratch.mkdir()
    words = [sys.executable, "-c", _STARVED, source, scratch, limit, *soft]
    done = subprocess.run(
        list(map(str, words)), capture_output=True, text=True, check=True, cwd=ROOT
    )
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.sample
@POSIX
def test_a_limit_on_file_size_costs_nobody_a_grade(zips, teams, tmp_path):
    """If the system limits file sizes, the submission is not graded; the next run tries again.

    The limit is reached while a zip file is unpacked, or while a folder is copied.
    """
    for number, source in enumerate((zips / "team-0.zip", teams / "team-0")):
        size = range(_MEMBER // 2, _MEMBER // 2 + 1)
        _, (settled, no_room, why, _) = starved(
            source, tmp_path / str(number), "RLIMIT_FSIZE", size
        )
        assert (settled, no_room) == (False, True)
        assert "too large" in why


@pytest.mark.slow
@pytest.mark.sample
@POSIX
@pytest.mark.parametrize("packed", [True, False])
def test_a_limit_on_open_files_costs_nobody_a_point(zips, teams, tmp_path, packed):
    """If few files may be open at a time, a submission gets its usual grade or is tried again."""
    source = zips / "team-0.zip" if packed else teams / "team-0"
    few = range(3, 12)  # three files are open at the start; libraries open a few more
    (_, _, _, whole), *others = starved(source, tmp_path / "s", "RLIMIT_NOFILE", few)
    assert any(not settled for settled, *_ in others)
    assert {grade for settled, _, _, grade in others if settled} <= {whole}


def test_undecodable_content_is_refused_for_good(tmp_path):
    """If an archive's content cannot be decoded, the submission is refused for good.

    The operating system reports no error, so the archive itself must be at fault.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_BZIP2) as packed:
        packed.writestr("submission.toml", "version = 1\n" * 1000)
    content = bytearray(buffer.getvalue())
    content[60:70] = b"\xff" * 10  # these are compressed bytes
    archive = tmp_path / "broken.zip"
    archive.write_bytes(content)
    outcome = grade_hand_in(
        HandIn(id="team", key="k", sources=(archive,)), rubric=RUBRIC, scratch=tmp_path
    )
    assert (outcome.status, outcome.settled) == ("failed", True)
