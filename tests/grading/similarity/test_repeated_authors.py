"""A person in several submissions is reported to the TA without an accusation."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.grading.gradings import Grading
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.similarity.class_questions import (
    RepeatedAuthors,
    find_repeated_authors,
    with_recordings,
)
from pipeline.grading.similarity.copies import same_team
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.read import read_data
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.grades import book_of, make_grade, make_outcome, two_cart_rubric


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[bytes]:
    """Return the fingerprints of two submissions with different recordings."""
    folder = tmp_path_factory.mktemp("teams")
    for seed in (0, 1):
        write_submission(folder / f"{seed}", "throne-1dof", seed=seed, compact=True)
    return [fingerprint(read_data(load_submission(folder / f"{seed}")).records) for seed in (0, 1)]


def told(folder: Path, recordings, *, anonymous: bool = False) -> list[RepeatedAuthors]:
    """Write a class in which Eve submits Bob's recordings and names Bob and herself as authors."""
    teams = {"team-1": ("bob",), "team-2": ("carl",), "team-9": ("eve", "Bob ")}
    prints = {"team-1": recordings[0], "team-2": recordings[1], "team-9": recordings[0]}
    class_ = [
        make_outcome(make_grade(name, authors=authors), fingerprints=prints[name])
        for name, authors in teams.items()
    ]
    rubric = two_cart_rubric().model_copy(update={"anonymous": anonymous})
    with book_of(folder, *class_, rubric=rubric) as book:
        return write_outputs(book, folder)


def test_a_copy_that_names_its_victim_is_reported(recordings, tmp_path):
    """If a copied submission names its victim as an author, the class page says so.

    The page names the person and both submissions, and counts their common recordings.
    """
    (double,) = told(tmp_path, recordings)
    assert (double.authors, double.submissions) == (("bob",), ("team-1", "team-9"))
    assert double.recordings >= 3
    assert re.match(rf"bob .*team-1 and team-9, .* {double.recordings} ", str(double))
    page = re.sub(r"<[^>]+>", "", (tmp_path / "class.html").read_text(encoding="utf-8"))
    assert str(double) in page
    feedback = (tmp_path / "feedback/team-9/feedback.html").read_text(encoding="utf-8")
    assert "team-1" not in feedback


def test_without_names_nobody_is_named(recordings, tmp_path):
    """In an anonymous grading, the message has the submissions' pseudonyms and names no person."""
    (double,) = told(tmp_path, recordings, anonymous=True)
    assert len(re.findall(r"anon-\w+", str(double))) == 2
    assert not re.search("bob|eve|team", str(double))


def test_each_common_recording_is_counted_once(recordings):
    """If four submissions have the same recordings, each recording is counted once."""
    prints = [
        Grading(submission=f"t{i}", authors=("s1",), fingerprints=recordings[0]) for i in range(4)
    ]
    counted = []
    for some in (prints[:2], prints):
        doubles = find_repeated_authors({one.submission: one.authors for one in some})
        counted += [double.recordings for double in with_recordings(doubles, some)]
    assert counted[0] == counted[1] >= 3


def test_a_submission_without_fingerprints_was_not_compared(recordings):
    """If a submission has no fingerprints, the message says that it could not be compared."""
    for left, compared in ((b"", False), (recordings[1], True)):
        prints = [
            Grading(submission=name, authors=("s1",), fingerprints=kept)
            for name, kept in (("a", recordings[0]), ("b", left))
        ]
        (double,) = with_recordings(find_repeated_authors({"a": ("s1",), "b": ("s1",)}), prints)
        assert (double.recordings, double.compared) == (0, compared)
        assert ("compared" in str(double)) is not compared


def test_partners_in_two_submissions_are_reported_once():
    """Two partners who are both in the same two submissions are reported once.

    An author of two other submissions gets a separate message.
    """
    teams = {"a": ("x", "y"), "b": ("Y", "x"), "c": ("z",), "d": ("z", "x2")}
    both, alone = find_repeated_authors(teams)
    assert (both.authors, both.submissions) == (("x", "y"), ("a", "b"))
    assert (alone.authors, alone.submissions) == (("z",), ("c", "d"))
    assert str(both).startswith("x and y ")
    assert str(replace(both, authors=("", ""))).startswith("2 people ")


def test_nobody_is_reported_for_one_submission():
    """If each person is in only one submission, nothing is reported.

    An id that one submission lists twice counts once.
    """
    assert find_repeated_authors({"a": ("x", "y"), "b": ("z", "Z ")}) == []
    (double,) = find_repeated_authors({f"t{i}": ("S\n1",) for i in range(10)})
    assert str(double).startswith("S 1 ")
    assert "2 more" in str(double)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        (("a", "b"), ("a", "b"), True),
        (("a", "b"), ("c", "B "), True),
        (("a", "b"), ("c", "d"), False),
        ((), (), False),
    ],
)
def test_teams_with_a_common_person_are_the_same_team(first, second, same):
    """A new partner makes no other team (`same_team`): shared recordings are then no copies."""
    one, other = (
        make_outcome(make_grade(name, authors=authors))
        for name, authors in (("team-1", first), ("team-2", second))
    )
    assert same_team(one, other) == same
