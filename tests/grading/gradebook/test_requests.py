"""Students can ask for a review of their points, in SQLite and in PostgreSQL."""

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
from sqlalchemy import Engine
from sqlalchemy.event import listen, remove

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import MOST_LETTERS, MOST_OPEN, Conflict, RequestRefused
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import history_text
from pipeline.grading.publish.pseudonyms import history_of, pseudonyms_in
from tests.helpers.grades import book_of, failed_grade, finish, make_grade, seen, two_cart_rubric
from tests.helpers.grading_students import criterion
from tests.helpers.places import ROOT

RUBRIC = two_cart_rubric()
CRITERIA = [criterion.id for criterion in RUBRIC.criteria]
HALF = make_grade("team-1", share=0.5)


def answer(book, points, text="looked"):
    """Answer the oldest request."""
    (asked, *_) = book.queue().waiting
    about = (asked[0].submission, asked[1].criterion)
    book.answer(*about, points, text=text, by="Ada", version=seen(asked))


def test_an_answer_and_its_points_count_at_once(book):
    """The students see an answer and its points at once, and a regrade keeps both.

    The history lists each step.
    """
    book.ask("team-1", "laws", why="  see\npage 3 ", by="s1")
    assert book.n_waiting() == 1
    ((entry, request),) = book.queue().waiting
    assert (entry.submission, request.events[0].text) == ("team-1", "see\npage 3")
    answer(book, 1.0, text="right")
    own = book.own_feedback("team-1")
    assert own.requests["laws"].state == "answered"
    laws = criterion(own.grade, "laws")
    assert laws.points == 1.0
    assert laws.message.endswith("right")
    events = [(e.what, e.points, e.by) for e in book.history("team-1")[1][-3:]]
    assert events == [("asked", None, "s1"), ("override", 1.0, "Ada"), ("answered", 1.0, "Ada")]
    finish(book, make_grade("team-1", share=0.25), make_grade("team-2", share=0.5), key="again")
    again = book.own_feedback("team-1")
    assert again.requests == own.requests
    assert criterion(again.grade, "laws").points == 1.0
    assert book.n_waiting() == 0


def test_points_stay_if_the_answer_gives_none(book):
    """If an answer gives no points, the points stay as they are."""
    book.ask("team-1", "laws", why="see page 3", by="s1")
    answer(book, None, text="page 3")
    own = book.own_feedback("team-1")
    assert own.requests["laws"].events[-1].text == "page 3"
    assert not own.overrides


def test_a_criterion_is_asked_for_once_unless_reopened(book):
    """A team can ask about a criterion only once, unless a TA reopens the request.

    Other criteria and other teams are not affected.
    """
    book.ask("team-1", "laws", why="one", by="s1")
    for state in ("asked", "answered"):
        with pytest.raises(RequestRefused, match="already"):
            book.ask("team-1", "laws", why="two", by="s2")
        assert book.own_feedback("team-1").requests["laws"].state == state
        if state == "asked":
            answer(book, None)
    book.ask("team-1", "pieces", why="other criterion", by="s1")
    book.ask("team-2", "laws", why="other team", by="s9")
    (settled,) = book.queue("team-1").settled
    book.reopen("team-1", "laws", by="Bob", version=seen(settled))
    book.ask("team-1", "laws", why="two", by="s2")
    order = [(entry.submission, one.criterion) for entry, one in book.queue().waiting]
    assert order == [("team-1", "pieces"), ("team-2", "laws"), ("team-1", "laws")]
    steps = [event.what for event in book.own_feedback("team-1").requests["laws"].events]
    assert steps == ["asked", "answered", "reopened", "asked"]


@pytest.mark.parametrize(
    ("criterion", "why", "said"),
    [
        ("laws", " \n", "write what"),
        ("laws", "", "write what"),
        ("laws", "x" * (MOST_LETTERS + 1), "1,000 characters, .*1,001"),
        ("nothing", "x", "were lost"),
        ("", "x", "were lost"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(book, criterion, why, said):
    """A request that makes no sense is refused, and nothing is stored."""
    with pytest.raises(RequestRefused, match=said):
        book.ask("team-1", criterion, why=why, by="s1")
    assert book.n_waiting() == 0


def test_a_criterion_with_all_points_cannot_be_asked_about(book):
    """A criterion that was never judged can be asked about, since its points are lost too."""
    finish(book, make_grade("team-1"), failed_grade("team-2", "no submission.toml"), key="new")
    with pytest.raises(RequestRefused, match="were lost"):
        book.ask("team-1", "laws", why="more", by="s1")
    book.ask("team-2", "laws", why="the file was in the zip", by="s2")
    answer(book, 0.5, text="found it")
    assert book.own_feedback("team-2").grade.points == 0.5


def test_few_requests_wait_at_once(book):
    """A team can have only a few open requests; after an answer it can ask again."""
    for asked in CRITERIA[:MOST_OPEN]:
        book.ask("team-1", asked, why="x", by="s1")
    with pytest.raises(RequestRefused, match=f"^{MOST_OPEN} "):
        book.ask("team-1", CRITERIA[MOST_OPEN], why="x", by="s1")
    book.ask("team-2", CRITERIA[MOST_OPEN], why="x", by="s2")
    answer(book, None)
    book.ask("team-1", CRITERIA[MOST_OPEN], why="x", by="s1")


def test_students_can_read_and_ask_only_while_released(place):
    """Students can read and ask only while their class is released."""
    with Gradebook(place, assignment="lab", create=True) as book:
        assert book.own_feedback("team-1") is None
    with book_of(place, HALF) as book:
        for released in (None, True, False):
            if released is not None:
                book.release(released, by="prof")
            assert (book.own_feedback("team-1") is not None) == bool(released)
            if not released:
                with pytest.raises(RequestRefused, match="not released"):
                    book.ask("team-1", "laws", why="x", by="s1")
        book.release(True, by="prof")
        assert book.own_feedback("team-1", assignment="lab") is not None
        assert book.own_feedback("team-1", assignment="lab-2") is None
        for name in ("s-team-1", "team-9"):  # an author, and nobody
            with pytest.raises(ConfigError, match=name):
                book.own_feedback(name)
    with Gradebook(place, assignment="lab-2", create=True) as other:
        finish(other, HALF, key="2")
        assert other.own_feedback("team-1") is None


def test_an_answer_to_a_changed_request_is_refused(book):
    """An answer is refused if the request has changed since the TA saw it.

    Another TA may have answered, points may have been given by hand, or a regrade may have run.
    """
    for asked in ("laws", "pieces"):
        book.ask("team-1", asked, why="x", by="s1")
    laws, pieces = book.queue().waiting
    give = {"text": "mine", "by": "Bob"}
    book.answer("team-1", "laws", 1.0, text="hers", by="Ada", version=seen(laws))
    with pytest.raises(Conflict) as conflict:
        book.answer("team-1", "laws", 0.0, version=seen(laws), **give)
    now = conflict.value.now
    assert now is not None
    assert (now.points, now.by) == (1.0, "Ada")
    book.override("team-1", "pieces", 0.75, why="seen", by="Ada")
    with pytest.raises(Conflict):
        book.answer("team-1", "pieces", 0.0, version=seen(pieces), **give)
    (pieces,) = book.queue().waiting
    finish(book, make_grade("team-1", share=0.25), key="again")
    with pytest.raises(Conflict):
        book.answer("team-1", "pieces", 0.0, version=seen(pieces), **give)
    (settled,) = book.queue().settled
    with pytest.raises(RequestRefused, match="answer already"):
        book.answer("team-1", "laws", 0.0, version=seen(settled), **give)
    with pytest.raises(RequestRefused, match="answered request"):
        book.reopen("team-1", "pieces", by="Bob", version=seen(book.queue().waiting[0]))
    with pytest.raises(ConfigError, match="99"):
        answer(book, 99.0)
    with pytest.raises(RequestRefused, match="an answer"):
        answer(book, 1.0, text=" ")
    events = [event.what for event in book.history("team-1")[1]]
    assert (events.count("answered"), events.count("override")) == (1, 2)


def at_once(one, other):
    """Do two things at the same moment; return the sorted names of the errors, "" for none."""
    ready = Barrier(2)

    def run(act):
        ready.wait()
        try:
            act()
        except (Conflict, RequestRefused) as error:
            return type(error).__name__
        return ""

    with ThreadPoolExecutor(2) as pool:
        return sorted(pool.map(run, (one, other)))


def test_only_one_of_two_simultaneous_answers_counts(book, place):
    """If two TAs answer a request at the same moment, the other answer is a conflict."""
    with Gradebook(place) as other:
        for number in range(10):
            book.ask("team-1", "laws", why=f"round {number}", by="s1")
            version = seen(book.queue().waiting[0])
            points = 0.25 + 0.5 * (number % 2)  # points different from those of the round before

            def give(who, by, *, version=version, points=points):
                who.answer("team-1", "laws", points, text="x", by=by, version=version)

            found = at_once(lambda give=give: give(book, "Ada"), lambda give=give: give(other, "B"))
            assert found == ["", "Conflict"]
            book.reopen("team-1", "laws", by="Ada", version=seen(book.queue().settled[0]))
    what = [event.what for event in book.history("team-1")[1]]
    assert (what.count("answered"), what.count("override")) == (10, 10)


def test_the_queue_is_read_at_one_moment(place_in_postgresql):
    """A team that is removed while the queue is read is still in it; SQLite reads like this too."""
    with book_of(place_in_postgresql, HALF) as book, Gradebook(place_in_postgresql) as other:
        book.release(True, by="prof")
        book.ask("team-1", "laws", why="x", by="s1")
        left = ["FROM events", "remove"]

        def remove_team(_connection, _cursor, statement, *_) -> None:
            if left == ["remove"]:
                left.clear()
                other.remove(["team-1"])
            elif left and left[0] in statement:
                del left[0]

        listen(Engine, "before_cursor_execute", remove_team)
        try:
            queue = book.queue()
        finally:
            remove(Engine, "before_cursor_execute", remove_team)
        assert [request.criterion for _, request in queue.waiting] == ["laws"]
        assert book.queue().waiting == []


def test_only_one_of_two_simultaneous_requests_is_stored(book, place):
    """If two members of a team ask at the same moment, one request is stored, the other refused."""
    with Gradebook(place) as other:
        found = at_once(
            lambda: book.ask("team-1", "laws", why="x", by="s1"),
            lambda: other.ask("team-1", "laws", why="x", by="s2"),
        )
    assert found == ["", "RequestRefused"]
    assert book.n_waiting() == 1


def test_a_request_goes_with_the_people(book):
    """A request stays with its authors when their team gets another name.

    Another team that now has the old name does not get it.
    """
    book.ask("team-1", "laws", why="see page 3", by="s1")
    renamed = make_grade("group-1", share=0.5, authors=("s-team-1",))
    finish(book, renamed, moved={"team-1": "group-1"}, key="b")
    ((entry, request),) = book.queue().waiting
    assert (entry.submission, request.events[0].by) == ("group-1", "s1")
    answer(book, 1.0)
    finish(book, make_grade("group-1", share=0.5, authors=("someone",)), key="c")
    assert (book.n_waiting(), book.own_feedback("group-1").requests) == (0, {})


def test_a_criterion_that_is_gone_can_still_be_answered(book):
    """If a criterion was removed, a request about it can be answered, but not with points."""
    book.ask("team-1", "laws", why="x", by="s1")
    less = tuple(c for c in RUBRIC.criteria if c.id != "laws")
    finish(book, HALF, rubric=RUBRIC.model_copy(update={"criteria": less}))
    with pytest.raises(ConfigError, match="such criterion"):
        answer(book, 1.0)
    answer(book, None, text="nobody loses points for it now")
    assert book.n_waiting() == 0


def test_an_anonymous_history_hides_who_asked(book):
    """An anonymous history hides who asked, even if the student's text contains a name."""
    finish(book, HALF, rubric=RUBRIC.model_copy(update={"anonymous": True}))
    book.ask("team-1", "laws", why="I, u42 of team-1 (S-team-1), see page 3", by="u42")
    text = history_text(*history_of(book, pseudonyms_in(book)["team-1"]))
    assert not [name for name in ("u42", "team-1") if name in text.casefold()]
    assert "asked " in text
    assert "u42" in history_text(*history_of(book, "team-1"))


@pytest.mark.slow
@pytest.mark.parametrize("kills", [pytest.param(8, marks=pytest.mark.sample), 100])
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_a_kill_leaves_an_answer_with_its_points_or_neither(place, kills):
    """If the answering process is killed, an answer is stored with its points or not at all."""
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", place, str(kills), "answers"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    done, within, told, _ = map(int, re.findall(r"\d+", said.stdout))
    assert done == kills
    assert within > kills // 4  # most processes lived long enough to answer
    assert told >= within
