"""A class is all that was graded: one hand-in by itself changes nothing of the others."""

import csv
import json
import re
import shutil
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.batch import Batch
from pipeline.grading.batch_run import grade_class
from pipeline.grading.gradebook import Gradebook
from pipeline.grading.history import history_text
from pipeline.grading.intake import find_hand_ins
from pipeline.grading.outputs import write_outputs
from pipeline.grading.runner import Limits
from pipeline.synthesis import write_submission
from tests.grades import make_grade, make_outcome, two_cart_rubric
from tests.test_schemas import assert_fits

RUBRIC = two_cart_rubric()


@pytest.fixture(scope="module")
def school(tmp_path_factory) -> Path:
    """Two sections with a team-1 each, and a team-2 that has the step of the first one."""
    folder = tmp_path_factory.mktemp("school")
    for seed, name in enumerate(("A/team-1", "B/team-1", "B/team-2")):
        write_submission(
            folder / name,
            chain="throne-1dof",
            seed=seed,
            authors=(f"s{seed}",),
            compact=True,
            reported=True,
        )
    step = (folder / "A/team-1/data/step-1.csv").read_bytes()
    (folder / "B/team-2/data/step-2.csv").write_bytes(step)
    return folder


def grade(*paths: Path, out: Path, rubric: Path = Path("throne-1dof")):
    return grade_class(
        paths,
        rubric_file=rubric,
        out=out,
        jobs=1,
        cluster=None,
        limits=Limits(),
        figures=False,
        progress=lambda done, total, last: None,
    )


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "grades.csv").open(encoding="utf-8", newline="") as file:
        return {row["submission"]: row for row in csv.DictReader(file)}


def pages(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in ("grades.csv", "class.html")}


def test_a_late_hand_in_by_itself_keeps_the_class(school, tmp_path):
    """Its id, everybody's rows and feedback, and the sharing on both sides are as if all ran."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    grade(school, out=whole)
    grade(school, out=parts)
    done = grade(school / "A" / "team-1", out=parts)
    assert (done.total, done.sharing) == (1, 2)
    assert done.remarks == (
        "not in this run, kept as they were: B-team-1 and team-2 (cartlab remove takes one off)",
    )
    for file in (parts / "feedback").glob("*/grade.json"):
        assert_fits("grade", file.read_text(encoding="utf-8"))
    assert rows(parts) == rows(whole)
    assert list(rows(parts)) == ["A-team-1", "B-team-1", "team-2"]
    assert pages(parts) == pages(whole)
    assert sorted(path.name for path in (parts / "feedback").iterdir() if path.is_dir()) == [
        "A-team-1", "B-team-1", "team-2",
    ]  # fmt: skip


def test_a_renamed_folder_is_told(school, tmp_path):
    """Who is on the list under two names is said, as one of them is to be removed."""
    out = tmp_path / "out"
    grade(school / "B" / "team-1", out=out)
    done = grade(shutil.copytree(school / "B" / "team-1", tmp_path / "team-one"), out=out)
    kept, double = done.remarks
    assert kept == "not in this run, kept as they were: team-1 (cartlab remove takes one off)"
    assert re.fullmatch(
        r"s1 is in team-1 and team-one, which have \d+ recordings in common: see class\.html",
        double,
    )
    assert done.sharing == 0


def test_a_mended_id_of_an_author_accuses_nobody(school, tmp_path):
    """Capitals, blanks, or another id for the same recordings, are no other team."""
    own, out = shutil.copytree(school / "B" / "team-1", tmp_path / "team-1"), tmp_path / "out"
    file = own / "submission.toml"
    text = file.read_text(encoding="utf-8")
    for typed in ("s1", " S1 ", "s 17"):
        file.write_text(text.replace('"s1"', f'"{typed}"'), encoding="utf-8")
        done = grade(own, out=out)
        assert done.sharing == 0
    assert done.remarks == (
        "team-1 is now by others, 's 17' in place of ' S1 ': where both count, give one folder "
        "another name",
    )


def test_the_rubric_of_those_kept_is_told(tmp_path):
    """Who stays on the list is by the rubric that graded them, whatever it is called now."""
    a, b = make_outcome(make_grade("a")), make_outcome(make_grade("b"))
    other = RUBRIC.model_copy(update={"criteria": RUBRIC.criteria[:-1]})
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for outcome in (a, b):
            book.put(outcome)
        book.finish(Batch(keys=(a.key,), shared={}), rubric=other)
        both = Batch(keys=(a.key, b.key), shared={})
        book.finish(both, rubric=other.model_copy(update={"title": "Lab", "anonymous": True}))
        assert book.by_other_rubrics() == []
        book.finish(both, rubric=RUBRIC)
        assert book.by_other_rubrics() == ["a", "b"]


def test_who_is_removed_is_off_every_list_but_history(tmp_path):
    """The pages are without them; their history tells it, and graded again they are back."""
    outcomes = [make_outcome(make_grade(name)) for name in ("a", "b", "c")]
    everybody = Batch(keys=tuple(o.key for o in outcomes), shared={})
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
        book.finish(everybody, rubric=RUBRIC)
        assert book.remove(["S-B", "c"]) == ["b", "c"]
        write_outputs(book, tmp_path)
        assert list(rows(tmp_path)) == ["a"]
        assert [p.name for p in (tmp_path / "feedback").iterdir() if p.is_dir()] == ["a"]
        assert book.names() == ["a"]
        for team in ("b", "s-b"):
            name, events = book.history(team)
            assert (name, [event.what for event in events]) == (
                "b",
                ["graded", "listed", "removed"],
            )
        assert history_text(name, events).endswith("removed   off the class list")
        with pytest.raises(ConfigError, match="b: no such submission"):
            book.remove(["b"])
        book.finish(everybody, rubric=RUBRIC)
        assert book.names() == ["a", "b", "c"]
        book.remove(["a", "b", "c"])
        write_outputs(book, tmp_path)
        assert rows(tmp_path) == {}


def test_a_failed_second_try_hides_no_recordings(tmp_path):
    """What was handed in first is still known after a timeout, and a replaced version too."""
    grade_ = make_grade("team")
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for key, prints in (("1", b"first"), ("2", b""), ("3", b"second"), ("4", b"first")):
            book.put(make_outcome(grade_, key=key, fingerprints=prints))
        assert [p.fingerprints for p in book.prints()] == [b"first", b"second"]
        assert all(p.of_class for p in book.prints())
    with Gradebook(tmp_path, assignment="another", create=True) as book:
        assert not any(p.of_class for p in book.prints())


def test_an_override_stays_with_the_same_person(tmp_path):
    """An id in capitals is the same person's; another id is another's."""
    grades = [make_grade("team", authors=(who,)) for who in ("ada 1", " Ada  1", "bob")]
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        kept = []
        for key, one in enumerate(grades):
            book.put(make_outcome(one, key=str(key)))
            book.finish(Batch(keys=(str(key),), shared={}), rubric=RUBRIC)
            if not kept:
                book.override("ADA 1", RUBRIC.criteria[0].id, 0.0, why="x", by="y")
            kept.append(bool(book.entry("team").overrides))
        assert kept == [True, True, False]


def test_the_id_of_a_class_so_far_is_kept(school, tmp_path):
    """Only where the longer id is on the list and the plain one is not."""
    path = [school / "A" / "team-1"]
    for known, id_ in (
        ((), "team-1"),
        (("A-team-1", "B-team-1"), "A-team-1"),
        (("A-team-1", "team-1"), "team-1"),
    ):
        found = find_hand_ins(path, scratch=tmp_path / "scratch", known=known)
        assert [hand_in.id for hand_in in found] == [id_]


def test_only_the_feedback_that_changes_is_written_again(school, tmp_path):
    """A kept submission's page is the very file it was, unless a newcomer shares with it."""
    out = tmp_path / "out"
    grade(school / "B", out=out)
    before = {p: p.stat().st_mtime_ns for p in (out / "feedback").glob("team-1/*")}
    grade(shutil.copytree(school / "A" / "team-1", tmp_path / "team-0"), out=out)
    assert len(before) == 2
    assert {p: p.stat().st_mtime_ns for p in before} == before
    document = json.loads((out / "feedback/team-2/grade.json").read_text(encoding="utf-8"))
    assert [flag["code"] for flag in document["flags"]].count("shared_data") == 1
