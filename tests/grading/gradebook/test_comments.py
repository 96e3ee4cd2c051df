"""A TA's comment on a criterion is shown to the team, and the points stay automatic."""

import pytest

from pipeline.grading.gradebook.decisions import WantedPoints
from pipeline.grading.gradebook.history import history_text
from tests.helpers.grades import finish, make_grade, seen
from tests.helpers.grading_students import criterion

NOTE = "Mind the unit."


def regrade(book):
    """Grade the team again, now with all points."""
    finish(book, make_grade("team-1"), key="again")


def change(book, points, why=NOTE):
    """Save the form of a criterion as the desk does."""
    seen = book.entry("team-1").version("pieces")
    book.change("team-1", "pieces", points, why=why, by="Ada", version=seen)


def wish(why=NOTE):
    return WantedPoints(submission="team-1", criterion="pieces", points=None, why=why, comment=True)


def comment_all(book, why=NOTE):
    """Comment on one criterion of several teams at once."""
    return book.change_all([wish(why)], by="Ada")


def pieces(book):
    """Return the criterion `pieces` of team-1 as it counts now."""
    return criterion(book.entry("team-1").grade, "pieces")


def notes(book):
    """Return what follows the automatic message."""
    return pieces(book).message.removeprefix("omega_1 is off.").strip()


@pytest.mark.parametrize("say", [lambda book: change(book, 0.5), comment_all])
def test_a_comment_does_not_freeze_points(book, say):
    """When a team with a comment is graded again, it gets the new points and keeps the comment."""
    assert pieces(book).points == 0.5
    say(book)
    assert notes(book) == NOTE
    assert book.entry("team-1").overrides == {}
    regrade(book)
    assert (pieces(book).points, pieces(book).outcome) == (1.0, "pass")
    assert pieces(book).message == f"As expected. {NOTE}"
    (said,) = [event for event in book.history("team-1")[1] if event.what == "comment"]
    assert (said.by, said.text) == ("Ada", NOTE)
    assert f"Ada: {NOTE}" in history_text(*book.history("team-1"))


@pytest.mark.parametrize("say", [lambda book: change(book, 0.0), comment_all])
def test_points_by_hand_stay_by_hand_with_a_comment(book, say):
    """If points were given by hand, a comment replaces their reason and the points stay."""
    change(book, 0.0, why="copied")
    say(book)
    assert pieces(book).message.endswith(f": {NOTE}")
    assert pieces(book).points == 0.0
    regrade(book)
    assert pieces(book).points == 0.0


def test_undo_brings_back_the_earlier_comment(book):
    """Undo removes a comment; if it had replaced an earlier comment, the earlier one returns."""

    def undo():
        book.undo("team-1", "pieces", by="Ada", version=book.entry("team-1").version("pieces"))

    comment_all(book)
    undo()
    assert notes(book) == ""
    comment_all(book)
    change(book, 1.0, why="right")
    undo()
    assert notes(book) == NOTE
    assert (pieces(book).points, book.entry("team-1").overrides) == (0.5, {})
    together = comment_all(book, why="Page 3.")
    assert comment_all(book, why="Page 3.").teams == 0
    book.undo_all(together.at, by="Ada")
    assert notes(book) == NOTE


def test_a_preview_shows_what_a_comment_changes(book):
    """Before a comment is saved, its preview shows the new message and unchanged points."""
    ((now, after),) = book.preview_all([wish("x")])
    assert after.grade.points == now.grade.points
    assert criterion(after.grade, "pieces").message == f"{pieces(book).message} x"


def test_an_answer_with_the_same_points_leaves_them_automatic(book):
    """If an answer confirms the automatic points, a later regrade may still change these points."""
    book.ask("team-1", "pieces", why="please", by="s1")
    (queued,) = book.queue().waiting
    book.answer("team-1", "pieces", 0.5, text="right", by="Ada", version=seen(queued))
    regrade(book)
    assert pieces(book).points == 1.0
