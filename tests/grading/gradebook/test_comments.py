"""A TA's comment on a criterion is shown to the team, and the points stay automatic."""

import sqlite3
from contextlib import closing

import pytest
from sqlalchemy import create_engine, text

from pipeline.grading.gradebook.history import history_text
from pipeline.grading.gradebook.override import WantedPoints
from pipeline.grading.gradebook.request_gradebook import RequestGradebook
from pipeline.grading.gradebook.schema import FILE
from pipeline.grading.gradebook.shared_gradebook import SharedGradebook
from pipeline.grading.gradings import Batch
from tests.helpers.grades import make_grade, make_outcome, two_cart_rubric

RUBRIC = two_cart_rubric()


@pytest.fixture
def book(place):
    """Return a gradebook with a team that has half of all points."""
    with SharedGradebook(place, assignment="lab", create=True) as opened:
        grade(opened, share=0.5)
        yield opened


def grade(book, *, share):
    """Grade the team again, as after a change of the rubric or of the submission."""
    outcome = make_outcome(make_grade("team-1", share=share), key=f"{share}")
    book.put(outcome)
    book.finish(Batch(keys=(outcome.key,), shared={}), rubric=RUBRIC)


def change(book, points, why="Mind the unit.", criterion="pieces"):
    """Save the form of a criterion as the desk does."""
    seen = book.team("team-1").versions[criterion]
    book.change("team-1", criterion, points, why=why, by="Ada", version=seen)


def comment_all(book, why="Mind the unit."):
    """Comment on one criterion of several teams at once."""
    wish = WantedPoints(submission="team-1", criterion="pieces", points=None, why=why, comment=True)
    return book.change_all([wish], by="Ada")


def pieces(book):
    """Return the criterion `pieces` of team-1 as it counts now."""
    return next(c for c in book.entry("team-1").grade.criteria if c.id == "pieces")


@pytest.mark.parametrize("say", [lambda book: change(book, 0.5), comment_all])
def test_a_comment_does_not_freeze_points(book, say):
    """When a team with a comment is graded again, it gets the new points and keeps the comment."""
    assert pieces(book).points == 0.5
    say(book)
    assert pieces(book).message == "omega_1 is off. Mind the unit."
    assert book.entry("team-1").overrides == {}
    grade(book, share=1.0)
    assert pieces(book).points == 1.0
    assert pieces(book).outcome == "pass"
    assert pieces(book).message == "As expected. Mind the unit."
    assert "comment   pieces: by Ada: Mind the unit." in history_text(*book.history("team-1"))


@pytest.mark.parametrize("say", [lambda book: change(book, 0.0), comment_all])
def test_points_by_hand_stay_by_hand_with_a_comment(book, say):
    """If points were given by hand, a comment replaces their reason and the points stay."""
    change(book, 0.0, why="copied")
    say(book)
    assert "to 0 of 1: Mind the unit." in pieces(book).message
    grade(book, share=1.0)
    assert pieces(book).points == 0.0


def test_undo_brings_back_the_earlier_comment(book):
    """Undo removes a comment; if it had replaced an earlier comment, the earlier one returns."""

    def undo():
        book.undo("team-1", "pieces", by="Ada", version=book.team("team-1").versions["pieces"])

    comment_all(book)
    undo()
    assert pieces(book).message == "omega_1 is off."
    comment_all(book)
    change(book, 1.0, why="right")
    undo()
    assert pieces(book).message == "omega_1 is off. Mind the unit."
    assert (pieces(book).points, book.entry("team-1").overrides) == (0.5, {})
    together = comment_all(book, why="See page 3.")
    assert comment_all(book, why="See page 3.").teams == 0
    book.undo_all(together.at, by="Ada")
    assert pieces(book).message == "omega_1 is off. Mind the unit."


def test_a_preview_shows_what_a_comment_changes(book):
    """Before a comment is saved, its preview shows the new message and unchanged points."""
    wish = WantedPoints(submission="team-1", criterion="pieces", points=None, why="x", comment=True)
    (tried,) = book.try_all([wish])
    assert tried.after.points == tried.now.points
    assert [c.message for c in tried.after.criteria if c.id == "pieces"] == ["omega_1 is off. x"]


def test_an_answer_with_the_same_points_leaves_them_automatic(book, place):
    """If an answer confirms the automatic points, a later regrade may still change these points."""
    with RequestGradebook(place) as shared:
        shared.release(True, by="prof")
        shared.ask("team-1", "pieces", why="please", by="s1")
        (queued,) = shared.queue().waiting
        shared.answer("team-1", "pieces", 0.5, text="right", by="Ada", version=queued.version)
    grade(book, share=1.0)
    assert pieces(book).points == 1.0


def test_a_gradebook_without_comments_gets_them(book, place):
    """A gradebook written before comments existed opens, keeps overrides and accepts comments."""
    book.override("team-1", "laws", 0.0, why="no", by="Ada")
    book.close()
    if "://" in place:
        engine = create_engine(place.replace("postgresql:", "postgresql+psycopg:"))
        with engine.begin() as old:
            old.execute(text("ALTER TABLE overrides DROP COLUMN comment"))
        engine.dispose()
    else:
        with closing(sqlite3.connect(f"{place}/{FILE}")) as old:
            old.execute("ALTER TABLE overrides DROP COLUMN comment")
    with SharedGradebook(place) as opened:
        assert opened.entry("team-1").overrides["laws"].points == 0.0
        comment_all(opened)
        assert pieces(opened).message == "omega_1 is off. Mind the unit."
