"""A class is everything graded so far; grading one more submission keeps the others."""

import csv
import json
import re
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.batch.runner import find_class_changes
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Grading, HandIn, Setup
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.publish.outputs import write_outputs
from pipeline.resources import RUBRICS
from tests.helpers.grades import (
    book_of,
    failed_grade,
    finish,
    in_this_process,
    make_grade,
    make_outcome,
    two_cart_rubric,
)
from tests.helpers.grading_students import copy_step, write_team
from tests.test_schemas import assert_fits

RUBRIC = two_cart_rubric()


@pytest.fixture(scope="module")
def school(tmp_path_factory) -> Path:
    """Write two sections with one team-1 each, and a team-2 that copied one of their steps."""
    folder = tmp_path_factory.mktemp("school")
    for seed, name in enumerate(("A/team-1", "B/team-1", "B/team-2")):
        write_team(folder / name, seed)
    copy_step(folder / "A/team-1", folder / "B/team-2")
    return folder


@pytest.fixture(scope="module")
def known() -> dict[HandIn, Grading]:
    """Return the grades so far, for tests that grade the same files again."""
    return {}


@pytest.fixture(autouse=True)
def _here(monkeypatch, known):
    """Grade in this process, and each task only once; a separate worker would give the same."""

    def execute(tasks: Sequence[HandIn], setup: Setup) -> Iterator[Grading]:
        for task in tasks:
            once = replace(task, sources=())  # the key depends on the submitted files
            if once not in known:
                (known[once],) = in_this_process([task], setup)
            yield known[once]

    monkeypatch.setattr("pipeline.grading.batch.grade_class.run_here", lambda *, jobs: execute)


def grade(*paths: Path, out: Path, rubric: Path = Path("throne-1dof")):
    return grade_class(paths, rubric_file=rubric, out=out, options=Options(figures=False))


def give(out: Path, team: str, points: float) -> None:
    with Gradebook(out) as book:
        book.override(team, "pieces", points, why="x", by="y")
        write_outputs(book, out)


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "grades.csv").open(encoding="utf-8", newline="") as file:
        return {row["submission"]: row for row in csv.DictReader(file)}


def pages(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in ("grades.csv", "class.html")}


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("loss", ["missing", "emptied", "another"])
def test_feedback_without_its_gradebook_is_not_replaced(school, tmp_path, loss):
    """If the gradebook beside feedback is lost, grading is refused and nothing changes."""
    out = tmp_path / "out"
    grade(school, out=out)
    give(out, "team-2", 0.25)
    before, book = pages(out), out / "gradebook.sqlite"
    book.unlink()
    if loss == "emptied":
        book.touch()
    elif loss == "another":
        Gradebook(out, assignment="throne-1dof", create=True).close()
    with pytest.raises(ConfigError, match="Restore"):
        grade(school, out=out)
    assert pages(out) == before
    shutil.rmtree(out / "feedback")  # one of the choices in the message
    grade(school, out=out)


@pytest.mark.slow
@pytest.mark.sample
def test_a_late_submission_graded_alone_keeps_the_class(school, tmp_path):
    """A late submission graded alone gives the same class as grading all submissions together.

    The ids, rows, feedback and flags for shared data are the same.
    """
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    grade(school, out=whole)
    grade(school, out=parts)
    done = grade(school / "A" / "team-1", out=parts)
    assert (done.total, done.sharing) == (1, 2)
    (remark,) = done.remarks
    assert "B-team-1 and team-2" in remark
    for file in (parts / "feedback").glob("*/grade.json"):
        assert_fits("grade", file.read_text(encoding="utf-8"))
    assert rows(parts) == rows(whole)
    assert list(rows(parts)) == ["A-team-1", "B-team-1", "team-2"]
    assert pages(parts) == pages(whole)
    assert sorted(path.name for path in (parts / "feedback").iterdir() if path.is_dir()) == [
        "A-team-1", "B-team-1", "team-2",
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.sample
def test_forgotten_lateness_gives_a_message(school, tmp_path):
    """If a late submission is graded again without the table of days late, a message says so.

    A table that names the submission with 0 days gives no message.
    """
    out, late = tmp_path / "out", tmp_path / "late.csv"

    def grade_late(days: str | None):
        late.write_text(f"submission,days_late\nteam-1,{days}\n", encoding="utf-8")
        options = Options(figures=False, lateness=None if days is None else late)
        return grade_class(
            [school / "A" / "team-1"], rubric_file=Path("throne-1dof"), out=out, options=options
        ).remarks

    assert grade_late("2") == ()
    assert grade_late("2") == ()
    (remark,) = grade_late(None)
    assert "team-1" in remark
    assert float(rows(out)["team-1"]["days_late"]) == 0
    assert grade_late("2") == ()
    assert grade_late("0") == ()


@pytest.mark.slow
@pytest.mark.sample
def test_a_renamed_folder_is_the_same_submission(school, tmp_path):
    """A submission whose folder was renamed keeps its row and its points by hand.

    A message gives the new name.
    """
    out = tmp_path / "out"
    grade(school / "B" / "team-1", out=out)
    give(out, "team-1", 0.25)
    copy = shutil.copytree(school / "B" / "team-1", tmp_path / "team-one")
    for name in ("team-one", "TEAM-one", "team-1"):
        done = grade(copy.rename(tmp_path / name), out=out)
        copy = tmp_path / name
        (remark,) = done.remarks
        assert f" {name};" in remark
        assert not re.search("is (new|gone)", " ".join(done.changes))
        assert {n: (r["by_hand"], r["pieces"]) for n, r in rows(out).items()} == {
            name: ("pieces", "0.25")
        }
    with Gradebook(out) as book:
        book.override("team-1", "pieces", None, why="x", by="y")
    grade(copy.rename(tmp_path / "team-one"), out=out)
    assert rows(out)["team-one"]["by_hand"] == ""


@pytest.mark.parametrize(
    "author", [pytest.param("s0", marks=[pytest.mark.slow, pytest.mark.sample]), "s1"]
)
def test_a_strangers_folder_does_not_replace_a_team(school, tmp_path, author):
    """If a stranger's zip file contains a folder with a team's name, the team keeps its row.

    Points given by hand stay, and the stranger's submission gets a longer id. This holds even if
    the stranger's submission has the team's id or cannot be read.
    """
    out, folder = tmp_path / "out", tmp_path / "class"
    shutil.copytree(school / "B" / "team-1", folder / "team-1")
    (folder / "team-2").mkdir()
    (folder / "team-2" / "submission.toml").write_text("carts = ?", encoding="utf-8")
    grade(folder, out=out)
    give(out, "team-1", 0.25)
    give(out, "team-2", 0.75)
    before = rows(out)
    stranger = school / "A" / "team-1"
    toml = (stranger / "submission.toml").read_text(encoding="utf-8")
    with zipfile.ZipFile(folder / "stranger.zip", "w") as archive:
        archive.writestr("team-1/submission.toml", toml.replace('"s0"', f'"{author}"'))
        for file in (stranger / "data").iterdir():
            archive.write(file, f"team-1/data/{file.name}")
    with zipfile.ZipFile(folder / "other.zip", "w") as archive:
        archive.writestr("team-2/submission.toml", "carts = !")
    grade(folder, out=out)
    now = rows(out)
    assert list(now) == ["class-team-1", "class-team-2", "other-team-2", "stranger-team-1"]
    for name, row in before.items():
        same = {key: row[key] for key in row if key not in ("submission", "reason")}
        assert now[f"class-{name}"] | same == now[f"class-{name}"]
    assert {now[name]["by_hand"] for name in ("stranger-team-1", "other-team-2")} == {""}


def test_a_rubric_of_another_name_is_refused(school, tmp_path):
    """A run is refused if its rubric's file name differs from that of the class's rubric.

    Otherwise, files and points given by hand would be lost.
    """
    out, rubric = tmp_path / "out", tmp_path / "lab.toml"
    shutil.copy(RUBRICS / "throne-1dof.toml", rubric)
    grade(school / "B" / "team-1", out=out, rubric=rubric)
    give(out, "team-1", 0.25)
    before = pages(out)
    mended = rubric.rename(tmp_path / "lab-mended.toml")
    with pytest.raises(ConfigError, match=r"lab\.toml"):
        grade(school / "B" / "team-1", out=out, rubric=mended)
    assert pages(out) == before
    grade(school / "B" / "team-1", out=out, rubric=mended.rename(rubric))
    assert rows(out)["team-1"]["by_hand"] == "pieces"


@pytest.mark.slow
@pytest.mark.sample
def test_a_corrected_id_in_another_folder_flags_nobody(school, tmp_path):
    """The platform's number identifies a submission even if its id and folder have changed.

    So nobody is flagged for sharing data with their own earlier submission.
    """
    out, folder = tmp_path / "out", tmp_path / "class"
    for inside, id_ in (("lab", "s 1"), ("lab-final", "s1")):
        shutil.rmtree(folder, ignore_errors=True)
        own = folder / "Jane Doe_1024_assignsubmission_file_" / inside
        shutil.copytree(school / "B" / "team-1", own)
        text = (own / "submission.toml").read_text(encoding="utf-8")
        mended = text.replace('"s1"', f'"{id_}"')
        (own / "submission.toml").write_text(mended, encoding="utf-8")
        shutil.copytree(school / "A" / "team-1", folder / "Bo_7_assignsubmission_file_" / "other")
        done = [grade(folder, out=out) for _ in range(2)]
        assert [one.sharing for one in done] == [0, 0]
        if inside == "lab":
            give(out, "lab", 0.25)
        else:  # a folder under another id belongs to another team, and a message says so
            (remark,) = (r for r in done[0].remarks if "'s1'" in r and "'s 1'" in r)
            with Gradebook(out) as book:
                dropped = [e.text for e in book.history("lab-final")[1] if e.what == "dropped"]
            assert [text in remark for text in dropped] == [True]
            assert "0.25 by " in dropped[0]
    assert {name: row["authors"] for name, row in rows(out).items()} == {
        "lab-final": "s1", "other": "s0",
    }  # fmt: skip


def test_teams_that_exchange_folders_keep_their_points(tmp_path):
    """If two teams exchange folders and record again, each team keeps its points by hand."""
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for run, names in enumerate(((("a", "ann"), ("b", "bo")), (("a", "bo"), ("b", "ann")))):
            outcomes = [
                make_outcome(make_grade(n, authors=(who,)), key=f"{run} {n}", fingerprints=b"")
                for n, who in names
            ]
            found = find_class_changes({o.submission: o.without_texts() for o in outcomes}, book)
            assert (dict(found.kept), found.taken_over) == ({}, ())
            assert found.moved == ({"a": "b", "b": "a"} if run else {})
            finish(book, *outcomes, moved=found.moved)
            if not run:
                book.override("ann", "pieces", 0.25, why="x", by="y")
        by_hand = {e.submission: list(e.overrides) for e in book.entries()}
    assert by_hand == {"a": [], "b": ["pieces"]}


def test_submissions_are_recognised_by_number_files_or_authors(tmp_path):
    """A submission is recognised by its platform's number, else by its files or its authors."""
    old = make_outcome(make_grade("old", authors=("ann",)), key="k-files", owner="A (canvas 7)")
    with book_of(tmp_path, old) as book:

        def goes_on_as(**others) -> str:
            found = {}
            for name, (who, key, owner) in others.items():
                new = make_outcome(make_grade(name, authors=who), key=key, owner=owner)
                found[name] = replace(new, fingerprints=b"").without_texts()
            return find_class_changes(found, book).moved.get("old", "")

        number = (("ann l",), "1-x", "A (canvas 7)")
        files = (("ann",), "2-files", "B (canvas 8)")
        people = (("Ann ",), "3-y", "")
        assert goes_on_as(people=people, files=files, number=number) == "number"
        assert goes_on_as(people=people, files=files) == "files"
        assert goes_on_as(people=people) == "people"
        assert goes_on_as(another=(("ann", "bo"), "3-y", "")) == ""
        assert goes_on_as(another=(("ann",), "3-y", "B (canvas 8)")) == ""
        assert goes_on_as(another=((), "3-y", "")) == ""


def test_two_empty_submissions_are_not_the_same(tmp_path):
    """Two empty submissions without authors are the same only if they are in the same folder."""
    old = make_outcome(failed_grade("team-3", "empty"), key="k-none", fingerprints=b"")
    with book_of(tmp_path, old) as book:
        new = [replace(old, submission=name).without_texts() for name in ("team-9", "class-team-3")]
        rows = {row.submission: row for row in new}
        assert find_class_changes(rows, book).moved == {"team-3": "class-team-3"}
        assert find_class_changes({"team-9": new[0]}, book).moved == {}


def test_a_corrected_id_of_an_author_flags_nobody(school, tmp_path):
    """If an author's id is corrected and the recordings are the same, nobody is flagged."""
    own, out = shutil.copytree(school / "B" / "team-1", tmp_path / "team-1"), tmp_path / "out"
    file = own / "submission.toml"
    text = file.read_text(encoding="utf-8")
    for typed in ("s1", " S1 ", "s 17"):
        file.write_text(text.replace('"s1"', f'"{typed}"'), encoding="utf-8")
        done = grade(own, out=out)
        assert done.sharing == 0
    (remark,) = done.remarks
    assert remark.startswith("team-1 ")
    assert [name in remark for name in ("'s 17'", "' S1 '")] == [True, True]


def test_kept_submissions_keep_their_rubric(tmp_path):
    """Submissions kept from an earlier run keep their rubric, and a list names them."""
    a, b = make_grade("a"), make_grade("b")
    other = RUBRIC.model_copy(update={"criteria": RUBRIC.criteria[:-1]})
    with book_of(tmp_path, a, rubric=other) as book:
        titled = other.model_copy(update={"title": "Lab", "anonymous": True})
        finish(book, a, b, rubric=titled)
        assert book.by_other_rubrics() == []
        finish(book, a, b)
        assert book.by_other_rubrics() == ["a", "b"]


def test_a_removed_submission_is_only_in_the_history(tmp_path):
    """A removed submission is only in the history until it is graded again."""
    everybody = [make_grade(name) for name in ("a", "b", "c")]
    with book_of(tmp_path, *everybody) as book:
        assert book.remove(["S-B", "c"]) == ["b", "c"]
        write_outputs(book, tmp_path)
        assert list(rows(tmp_path)) == ["a"]
        assert [p.name for p in (tmp_path / "feedback").iterdir() if p.is_dir()] == ["a"]
        assert [one.submission for one in book.listed()] == ["a"]
        for team in ("b", "s-b"):
            name, events = book.history(team)
            assert name == "b"
            assert [event.what for event in events] == ["graded", "listed", "removed"]
        with pytest.raises(ConfigError, match="no such"):
            book.remove(["b"])
        finish(book, *everybody)
        assert [one.submission for one in book.listed()] == ["a", "b", "c"]
        book.remove(["a", "b", "c"])
        write_outputs(book, tmp_path)
        assert rows(tmp_path) == {}


def test_a_failed_second_try_hides_no_recordings(tmp_path):
    """If a second grading fails, fingerprints of the first grading are still compared.

    Fingerprints of replaced versions are compared too.
    """
    grade_ = make_grade("team")
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for key, prints in (("1", b"first"), ("2", b""), ("3", b"second"), ("4", b"first")):
            book.put(make_outcome(grade_, key=key, fingerprints=prints))
        assert [p.fingerprints for p in book.fingerprints()] == [b"first", b"second"]
        assert all(p.of_class for p in book.fingerprints())
    with Gradebook(tmp_path, assignment="another", create=True) as book:
        assert not any(p.of_class for p in book.fingerprints())


def test_a_submission_graded_alone_keeps_its_id(school, tmp_path):
    """A submission graded alone keeps its id of the class list, even if this id is longer."""
    path = [school / "A" / "team-1"]
    for known, id_ in (
        ((), "team-1"),
        (("A-team-1", "B-team-1"), "A-team-1"),
        (("A-team-1", "team-1"), "team-1"),
    ):
        found = find_hand_ins(path, scratch=tmp_path / "scratch", known=known)
        assert [hand_in.id for hand_in in found] == [id_]


def test_only_changed_feedback_is_written_again(school, tmp_path):
    """Feedback of an earlier submission is rewritten only if a new one shares its recordings."""
    out = tmp_path / "out"
    grade(school / "B", out=out)
    before = {p: p.stat().st_mtime_ns for p in (out / "feedback").glob("team-1/*")}
    grade(shutil.copytree(school / "A" / "team-1", tmp_path / "team-0"), out=out)
    assert len(before) == 2
    assert {p: p.stat().st_mtime_ns for p in before} == before
    document = json.loads((out / "feedback/team-2/grade.json").read_text(encoding="utf-8"))
    assert [flag["code"] for flag in document["flags"]].count("shared_data") == 1
