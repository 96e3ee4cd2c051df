"""A TA repairs a team's `submission.toml` at the desk; the original is kept."""

import json
import zipfile
from html import unescape
from pathlib import Path

import pytest

from pipeline.grading.batch.grade_class import Options
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.intake.repairs import (
    FOLDER,
    Repair,
    Run,
    read_original,
    read_repairs,
    read_run,
    save_repair,
    save_run,
    text_key,
)
from pipeline.simulated.submission import write_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import at_desk
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("all_work_here")
TEAM = "/grades/0/team?of=team-07"
WHY = "the decimal comma"


@pytest.fixture
def handed_in(tmp_path):
    """Return a zip file of a submission with a mistake outside `[reported]`, and the right text."""
    folder = tmp_path / "student" / "team-07"
    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    right = (folder / "submission.toml").read_text("utf-8")
    (folder / "submission.toml").write_text(right.replace("carts = 1", "carts = 1,0"), "utf-8")
    path = tmp_path / "class" / "team-07.zip"
    path.parent.mkdir()
    pack(folder, path)
    return folder, path, right


def pack(folder: Path, path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(folder.parent).as_posix())


def grade(path: Path, out: Path) -> Grade:
    cartlab_here("grade", path.parent, "--rubric", "throne-1dof", "--out", out, "--jobs", "1")
    return current(out)


def current(out: Path) -> Grade:
    with Gradebook(out) as book:
        return book.entry("team-07").grade


@pytest.mark.slow
@pytest.mark.sample
def test_a_repaired_file_is_graded_and_stays_repaired(handed_in, tmp_path):
    """A repaired file is graded at once, and whenever the same file is graded again.

    The history names the person and the reason. A later version of the file is graded as it is.
    """
    folder, path, right = handed_in
    out, packed = tmp_path / "grades", path.read_bytes()
    before = grade(path, out)
    assert (before.status, before.points) == ("failed", 0)
    original = read_original(out, "team-07")
    assert original is not None
    assert original == right.replace("carts = 1", "carts = 1,0")

    with at_desk(opened=out) as ta:
        page = unescape(ta.get(TEAM).text)
        assert "Repair submission.toml" in page
        assert "carts = 1,0" in page
        sent = {"do": "repair", "by": "Ada", "of_text": text_key(original)}
        assert ta.post(TEAM, **sent, text=right, why="").status == 422
        typos = (
            original,
            right.replace("[system]", "[sytem]"),
            right.replace("carts = 1", "carts ="),
        )
        for text in typos:  # a repair with a mistake does not count
            refused = ta.post(TEAM, **sent, text=text, why=WHY)
            assert (refused.status, "repair" in refused.wrong_fields) == (422, True)
            assert text.strip() in unescape(refused.text)
            assert read_repairs(out, "team-07") == {}
        assert ta.post(TEAM, **{**sent, "of_text": "other"}, text=right, why=WHY).status == 422
        assert ta.post(TEAM, **sent, text=right.replace("\n", "\r\n"), why=WHY).status == 303
        until(lambda: current(out).status == "graded")
        page = unescape(ta.get(TEAM).text)
        assert "was repaired here" in page
        assert "carts = 1,0" in page  # the original is shown too

    found = current(out)
    assert (found.points, found.repaired) == (20, f"by Ada: {WHY}")
    assert [note for note in found.notes if "repaired" in note and note.endswith(f": {WHY}")]
    said = cartlab_here("history", out, "team-07").stdout
    assert f"repaired by Ada: {WHY}" in said
    assert path.read_bytes() == packed
    assert read_original(out, "team-07") == original

    (folder / "notes.md").write_text("Friction matters.\n", "utf-8")  # the same file, packed again
    pack(folder, path)
    assert grade(path, out).points == 20

    toml = folder / "submission.toml"
    toml.write_text(original.replace("carts", "carst"), "utf-8")
    pack(folder, path)
    again = grade(path, out)
    assert (again.status, again.repaired) == ("failed", "")
    toml.write_text(right, "utf-8")
    pack(folder, path)
    assert (grade(path, out).points, read_original(out, "team-07")) == (20, None)

    cartlab_here("remove", out, "team-07", "--erase")
    assert not (out / "repairs" / "team-07").exists()


@pytest.mark.slow
def test_the_history_names_who_repaired_a_file_that_cannot_be_graded(handed_in, tmp_path):
    """The history names the person and the reason also if the repaired file cannot be graded."""
    _, path, right = handed_in
    out = tmp_path / "grades"
    grade(path, out)
    original = read_original(out, "team-07")
    assert original
    repair = Repair(text=right.replace("carts = 1", "carts = 2"), by="Ada", why=WHY)
    save_repair(out, "team-07", repair, of=text_key(original))
    found = grade(path, out)
    assert (found.status, found.repaired) == ("failed", f"by Ada: {WHY}")
    said = cartlab_here("history", out, "team-07").stdout
    assert f"repaired by Ada: {WHY}" in said


@pytest.mark.slow
@pytest.mark.sample
def test_a_file_without_mistakes_is_not_offered_for_repair(handed_in, tmp_path):
    """A team's page offers the repair only if the file has a mistake, also in a number."""
    folder, path, right = handed_in
    out, toml = tmp_path / "grades", folder / "submission.toml"
    for text, offered in ((right, False), (right.replace("K = ", 'K = "" # ', 1), True)):
        toml.write_text(text, "utf-8")
        pack(folder, path)
        assert grade(path, out).status == "graded"
        with at_desk(opened=out) as ta:
            assert ("Repair submission.toml" in ta.get(TEAM).text) == offered


def test_an_anonymous_class_shows_no_file(handed_in, tmp_path):
    """If names are hidden, no file is shown or changed, because it contains them."""
    _, path, right = handed_in
    out = tmp_path / "grades"
    cartlab_here("grade", path, "--rubric", "throne-1dof", "--out", out, "--anonymous")
    document = json.loads(next((out / "feedback").glob("*/grade.json")).read_text("utf-8"))
    address = f"/grades/0/team?of={document['submission']}"
    with at_desk(opened=out) as ta:
        assert "Repair submission.toml" not in ta.get(address).text
        sent = {"do": "repair", "by": "Ada", "why": WHY, "text": right}
        assert ta.post(address, **sent, of_text="x").status == 404


def test_a_run_keeps_the_options_that_decide_its_result(tmp_path):
    """What was graded is kept with its limits and its choice of figures.

    Older files lack them,
    and are in another place.
    """
    options = Options(time_limit=7.0, memory_limit=2_000_000_000, figures=False, anonymous=True)
    run = Run(paths=("a",), rubric="r.toml", options=options.lasting())
    (tmp_path / FOLDER).mkdir()
    save_run(tmp_path, run)
    assert read_run(tmp_path) == run
    assert Options(**run.options) == options
    (tmp_path / "run.json").unlink()
    (tmp_path / FOLDER / "run.json").write_text('{"paths": ["a"], "rubric": "r.toml"}')
    assert read_run(tmp_path) == Run(paths=("a",), rubric="r.toml")
