"""A class is graded for the first time at the desk: from a folder or a zip, or not at all."""

import io
import stat
import struct
import sys
import zipfile
from pathlib import Path

import pytest

from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.intake.repairs import Run, read_run, save_run
from tests.helpers.desks import Answer, Visitor, at_desk, at_lab, listed_user
from tests.helpers.grades import n_graded, write_class
from tests.helpers.grading_students import write_team
from tests.helpers.waiting import until

NEW = "/grading/"
RUBRIC = "throne-1dof"


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    """Start desks in an empty folder."""
    folder = tmp_path / "root"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def packed(*teams: Path, **texts: str) -> bytes:
    """Return a zip of some folders and of further files."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for team in teams:
            for file in sorted(path for path in team.rglob("*") if path.is_file()):
                archive.write(file, file.relative_to(team.parent).as_posix())
        for name, text in texts.items():
            archive.writestr(name, text)
    return content.getvalue()


def send(who: Visitor, path: str, *files: tuple[str, bytes], **fields: str) -> Answer:
    """Send the form, with uploaded files."""
    return who.upload(path, files, **fields)


def finish(who: Visitor, address: str) -> Answer:
    """Wait until the grading of a class ends; return the page of the class."""
    until(lambda: "data-events" not in who.get(address).text)
    return who.get(address)


def with_false_size(raw: bytes) -> bytes:
    """Return a zip whose table of contents has a false length."""
    at = raw.rindex(b"PK\x05\x06") + 12
    return raw[:at] + struct.pack("<L", 0x7FFFFFFF) + raw[at + 4 :]


# ----------------------------------------------------------------------------- what is refused


@pytest.mark.usefixtures("all_work_here")
@pytest.mark.parametrize(
    ("typed", "refused"),
    [
        ({"paths": ""}, {"paths"}),
        ({"paths": "missing"}, {"paths"}),
        ({"paths": "~nobody-here/lab"}, {"paths"}),
        ({"paths": "notes.txt"}, {"paths"}),
        ({"paths": "empty"}, {"paths"}),
        ({"rubric": ""}, {"rubric"}),
        ({"rubric": "throne-7dof"}, {"rubric"}),
        ({"rubric": "bad.toml"}, {"rubric"}),
        ({"lateness": "missing.csv"}, {"lateness"}),
        ({"lateness": "bad.toml"}, {"lateness"}),
        ({"out": "full"}, {"out"}),
        ({"out": "notes.txt"}, {"out"}),
        ({"out": "missing/grades"}, {"out"}),
        ({"out": "class/team-1/grades"}, {"out"}),
        ({"out": "graded"}, {"out"}),
        ({"rubric": "x", "paths": "empty", "out": "full"}, {"rubric", "paths", "out"}),
    ],
    ids=lambda value: ",".join(f"{k}={v}" for k, v in value.items()) if type(value) is dict else "",
)
def test_a_form_that_cannot_be_graded_says_so_beside_the_field(root, typed, refused):
    """Each mistake is beside its field, all that was typed stays, and nothing is written."""
    (root / "class" / "team-1").mkdir(parents=True)
    (root / "class" / "team-1" / "submission.toml").write_text("version = 1\n")
    (root / "empty").mkdir()
    (root / "full").mkdir()
    for name in ("notes.txt", "bad.toml", "full/mine.txt"):
        (root / name).write_text("mine\n")
    write_class(root / "graded")
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    fields = {"paths": "class", "rubric": RUBRIC, "out": str(root / "grades"), **typed}
    if "out" in typed:
        fields["out"] = str(root / typed["out"])
    with at_desk() as who:
        answer = send(who, NEW, **fields)
        assert (answer.status, answer.wrong_fields) == (422, refused), answer.text
        assert answer.value("rubric") == fields["rubric"]
        assert answer.value("out") == fields["out"]
        assert 'href="/grades/' not in who.get("/").text
    found = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    assert {path for path in found if "graded" not in path.parts} == {
        path for path in before if "graded" not in path.parts
    }


@pytest.mark.parametrize(
    "files",
    [
        [("class.zip", b"not a zip")],
        [("class.zip", b"")],
        [("class.zip", packed(**{"readme.txt": "nothing"}))],
        [("class.zip", packed(**{"team/submission.toml": "version = 1\n"})[:-30])],
        [("class.zip", with_false_size(packed(**{"team/submission.toml": "version = 1\n"})))],
        [("class.rar", packed(**{"team/submission.toml": "version = 1\n"}))],
        [("a/class.zip", packed(**{"t/submission.toml": ""}))] * 2,
    ],
    ids=["no zip", "empty", "nothing to grade", "cut", "false size", "another format", "twice"],
)
@pytest.mark.usefixtures("all_work_here")
def test_a_zip_that_cannot_be_graded_leaves_nothing(root, files):
    """A bad upload is refused beside its field; no folder and no class is made."""
    with at_desk() as who:
        answer = send(who, NEW, *files, rubric=RUBRIC, out="grades")
        assert (answer.status, answer.wrong_fields) == (422, {"files"}), answer.text
        assert str(root.parent) not in answer.text.partition("files-wrong")[2].partition("</p>")[0]
    assert list(root.iterdir()) == []


def test_only_the_owner_grades(tmp_path):
    """On a lab server, nobody starts a grading; a class that is not graded yet offers no form."""
    grades = tmp_path / "grades"
    grades.mkdir()
    Gradebook(grades, create=True).close()
    books = '["grades"]'
    users = listed_user("t", "ta", gradebooks=books)
    users += listed_user("i", "instructor", gradebooks=books, workshop='"."')
    with at_lab(tmp_path, users) as visit:
        for name in ("t", "i"):
            who = visit(name)
            assert who.get(NEW).status == 403
            sent = {"paths": str(tmp_path), "rubric": RUBRIC}
            assert send(who, NEW, **sent, out="new").status == 403
            assert send(who, "/grades/0/grade", **sent).status == 403
            page = who.get("/grades/0/")
            assert page.state == {"grading": "none"}
            assert "<form" not in page.text
    assert not (tmp_path / "new").exists()


# ------------------------------------------------------------------------- real workers


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("anonymous", [False, True])
def test_a_class_is_graded_from_a_zip(root, tmp_path, anonymous):
    """An uploaded class is graded beside its desk, with late days, and joins the navigation.

    A file in the archive that points outside is not written. The upload is kept with the class, so
    the class can be graded again.
    """
    teams = [write_team(tmp_path / f"team-{n}", n) for n in (1, 2)]
    (tmp_path / "late.csv").write_text("submission,days_late\nteam-2,2\n", "utf-8")
    raw = packed(*teams, **{"../../evil/submission.toml": "version = 1\n"})
    sent = {"rubric": RUBRIC, "lateness": str(tmp_path / "late.csv"), "out": "lab 1"}
    sent |= {"anonymous": "1"} if anonymous else {}
    with at_desk() as who:
        assert who.get(NEW).value("out") == "grades"
        answer = send(who, NEW, ("C:\\fake\\my class.zip", raw), **sent)
        assert (answer.status, answer.headers["location"]) == (303, "/grades/0/")
        page = finish(who, "/grades/0/")
        assert 'id="teams"' in page.text
        assert ("team-1" in page.text) is not anonymous
        assert 'href="/grades/0/"' in who.get("/").text
        if anonymous:  # without paths, what was graded last is graded
            assert send(who, "/grades/0/grade", **sent).status == 303
            assert 'id="teams"' in finish(who, "/grades/0/").text
    out = root / "lab 1"
    kept = out / "handed-in" / "my class.zip"
    assert kept.read_bytes() == raw
    run = read_run(out)
    assert run is not None
    assert (run.paths, run.rubric) == ((str(kept),), RUBRIC)
    assert run.options["anonymous"] is anonymous
    with Gradebook(out) as book:
        late = {entry.submission: entry.grade.days_late for entry in book.entries()}
        assert late.items() >= {"team-1": 0, "team-2": 2}.items()
        assert book.rubric.anonymous is anonymous
    assert not (tmp_path / "evil").exists()
    assert not (root / "evil").exists()
    if sys.platform != "win32":
        assert stat.S_IMODE(out.stat().st_mode) == 0o700


@pytest.mark.slow
@pytest.mark.sample
def test_a_grading_that_was_stopped_is_continued(root, tmp_path):
    """A grading that was stopped, or whose desk ended, is started again with what was typed."""
    teams = tmp_path / "class"
    names = {f"team-{n}" for n in range(6)}  # enough for a Stop before the last
    for n, name in enumerate(names):
        write_team(teams / name, n)
    out = tmp_path / "grades"
    with at_desk() as who:
        assert send(who, NEW, paths=str(teams), rubric=RUBRIC, out="grades").status == 303
        page = who.get("/grades/0/")
        assert page.state == {"grading": "running"}
        until(lambda: n_graded(out) >= 1)
        who.post("/grades/0/stop")
        page = finish(who, "/grades/0/")
        assert page.state == {"grading": "stopped"}
    with at_desk(out) as who:
        page = who.get("/grades/0/")
        assert page.state == {"grading": "unfinished"}
        assert page.value("rubric") == RUBRIC
        assert str(teams) in page.text
        assert send(who, "/grades/0/grade", paths="", rubric=RUBRIC).status == 303
        assert 'id="teams"' in finish(who, "/grades/0/").text
    with Gradebook(out) as book:
        assert {entry.submission for entry in book.entries()} == names


def unfinished(out: Path, *paths: Path, **options: bool) -> Path:
    """Write the folder of a grading that did not end."""
    out.mkdir()
    Gradebook(out, create=True).close()
    save_run(out, Run(paths=tuple(map(str, paths)), rubric=RUBRIC, options=options))
    return out


@pytest.mark.usefixtures("all_work_here")
def test_a_refused_form_hides_names_as_before(root):
    """An unfinished anonymous class stays anonymous after a mistake, and shows no paths."""
    out = unfinished(root / "grades", root / "jane-doe.zip", anonymous=True)
    with at_desk(out) as who:
        page = who.get("/grades/0/")
        assert "jane-doe" not in page.text
        assert 'name="anonymous" value="1" checked' in page.text
        refused = send(who, "/grades/0/grade", rubric=RUBRIC, anonymous="1")
        assert (refused.status, refused.wrong_fields) == (422, {"paths"})
        assert "jane-doe" not in refused.text
        assert 'name="anonymous" value="1" checked' in refused.text


@pytest.mark.usefixtures("all_work_here")
def test_an_upload_never_replaces_another_one(root, tmp_path):
    """A zip with the name of an earlier upload is refused, unless it is the same."""
    first, second = (packed(write_team(tmp_path / name / "lab", n)) for n, name in enumerate("ab"))
    out = unfinished(root / "grades")
    (out / "handed-in").mkdir()
    (out / "handed-in" / "lab.zip").write_bytes(first)
    with at_desk(out) as who:
        for address in (NEW, "/grades/0/grade"):
            refused = send(who, address, ("lab.zip", second), rubric=RUBRIC, out=str(out))
            assert (refused.status, refused.wrong_fields) == (422, {"files"})
        same = send(who, NEW, ("lab.zip", first), rubric="x", out=str(out))
        assert "another file" not in same.text
        assert "rubric" in same.wrong_fields
    assert (out / "handed-in" / "lab.zip").read_bytes() == first


@pytest.mark.slow
@pytest.mark.sample
def test_one_damaged_zip_does_not_stop_the_others(root, tmp_path):
    """A damaged zip is a submission with a reason; a second request meanwhile changes nothing."""
    good = packed(write_team(tmp_path / "team-1", 1))
    many = [(f"team-{n}.zip", good) for n in range(20)]  # enough for a request meanwhile
    with at_desk() as who:
        files = [*many, ("damaged.zip", good[:-40])]
        assert send(who, NEW, *files, rubric=RUBRIC, out="grades").status == 303
        again = send(who, NEW, ("other.zip", good), rubric=RUBRIC, out="grades")
        assert (again.status, again.headers["location"]) == (303, "/grades/0/")
        finish(who, "/grades/0/")
    out = root / "grades"
    kept = {path.name for path in (out / "handed-in").iterdir()}
    assert kept == {name for name, _ in files}
    with Gradebook(out) as book:
        states = {entry.submission: entry.graded.status for entry in book.entries()}
    # The folders in the zips have one name, so the name of the zip comes first.
    named = {f"{Path(name).stem}-team-1": "graded" for name, _ in many}
    assert states == named | {"damaged": "failed"}


@pytest.mark.usefixtures("all_work_here")
def test_a_grading_that_did_not_end_may_have_its_folder_again(root, tmp_path):
    """The folder of an unfinished grading is accepted in the form; its class is opened once."""
    team = write_team(tmp_path / "team-1", 1)
    out = root / "grades"
    out.mkdir()
    Gradebook(out, create=True).close()
    save_run(out, Run(paths=(str(team),), rubric=RUBRIC))
    assert (out / FILE).is_file()
    with at_desk(out) as who:
        answer = send(who, NEW, paths="missing", rubric=RUBRIC, out=str(out))
        assert answer.wrong_fields == {"paths"}
        answer = send(who, "/grades/0/grade", paths="missing", rubric="x")
        assert (answer.status, answer.wrong_fields) == (422, {"paths", "rubric"})
        assert answer.state == {"grading": "unfinished"}
    run = read_run(out)
    assert run is not None
    assert run.paths == (str(team),)
