"""Students can ask for a review of their points, in SQLite and in PostgreSQL."""

import os
import re
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from threading import Barrier

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.history import history_text
from pipeline.grading.gradebook.request_gradebook import RequestGradebook
from pipeline.grading.gradebook.requests import MOST_LETTERS, MOST_OPEN, RequestRefused
from pipeline.grading.gradebook.schema import FILE
from pipeline.grading.gradebook.shared_gradebook import Conflict, SharedGradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.publish.anonymous import history_of, pseudonyms_in
from tests.helpers.grades import failed_grade, make_grade, make_outcome, two_cart_rubric
from tests.helpers.places import ROOT

RUBRIC = two_cart_rubric()
CRITERIA = [criterion.id for criterion in RUBRIC.criteria]


@pytest.fixture
def book(place):
    """Return a class of two teams that lost half of all points; the grades are released."""
    with RequestGradebook(place, assignment="lab", create=True) as book:
        finish(book, *(make_grade(name, share=0.5) for name in ("team-1", "team-2")))
        book.release(True, by="prof")
        yield book


def finish(book, *grades, moved=None, rubric=RUBRIC, key=""):
    """Store a batch with this grade."""
    outcomes = [make_outcome(grade, key=f"{key}{grade.submission}") for grade in grades]
    for outcome in outcomes:
        if book.known(outcome.key) is None:
            book.put(outcome)
    keys = tuple(outcome.key for outcome in outcomes)
    book.finish(Batch(keys=keys, shared={}, moved=moved or {}), rubric=rubric)


def answer(book, points, text="looked", by="Ada"):
    """Answer the oldest request."""
    (asked, *_) = book.queue().waiting
    book.answer(
        asked.entry.submission,
        asked.request.criterion,
        points,
        text=text,
        by=by,
        version=asked.version,
    )


def test_an_answer_and_its_points_count_at_once(book):
    """The students see an answer and its points at once, and a regrade keeps both.

    The history lists each step.
    """
    book.ask("team-1", "laws", why="  see\npage 3 ", by="s1")
    assert book.n_waiting() == 1
    (asked,) = book.queue().waiting
    assert (asked.entry.submission, asked.request.events[0].text) == ("team-1", "see\npage 3")

    answer(book, 1.0, text="you are right")

    own = book.own_feedback("team-1")
    assert own.requests["laws"].state == "answered"
    (laws,) = [c for c in own.entry.grade.criteria if c.id == "laws"]
    assert laws.points == 1.0
    assert laws.message.endswith("you are right")
    told = history_text(*book.history("team-1")).splitlines()[-3:]
    assert [re.sub(r".*UTC  ", "", line) for line in told] == [
        "asked     laws: by s1: see page 3",
        "override  laws: 1 by hand, by Ada: you are right",
        "answered  laws: 1 by hand, by Ada: you are right",
    ]
    finish(book, make_grade("team-1", share=0.25), make_grade("team-2", share=0.5), key="again ")
    again = book.own_feedback("team-1")
    assert again.requests == own.requests
    assert {c.id: c.points for c in again.entry.grade.criteria}["laws"] == 1.0
    assert book.n_waiting() == 0


def test_points_stay_if_the_answer_gives_none(book):
    """If an answer gives no points, the points stay as they are."""
    book.ask("team-1", "laws", why="see page 3", by="s1")
    answer(book, None, text="page 3 is about cart 2")
    own = book.own_feedback("team-1")
    assert own.requests["laws"].events[-1].text == "page 3 is about cart 2"
    assert not own.entry.overrides


def test_a_criterion_is_asked_for_once_unless_reopened(book):
    """A team can ask about a criterion only once, unless a TA reopens the request.

    Other criteria and other teams are not affected.
    """
    book.ask("team-1", "laws", why="one", by="s1")
    for state in ("asked", "answered"):
        with pytest.raises(RequestRefused, match="look at this criterion already"):
            book.ask("team-1", "laws", why="two", by="s2")
        assert book.own_feedback("team-1").requests["laws"].state == state
        if state == "asked":
            answer(book, None)
    book.ask("team-1", "pieces", why="other criterion", by="s1")
    book.ask("team-2", "laws", why="other team", by="s9")
    (settled,) = book.queue("team-1").settled
    book.reopen("team-1", "laws", by="Bob", version=settled.version)
    book.ask("team-1", "laws", why="two", by="s2")
    order = [(one.entry.submission, one.request.criterion) for one in book.queue().waiting]
    assert order == [("team-1", "pieces"), ("team-2", "laws"), ("team-1", "laws")]
    steps = [event.what for event in book.own_feedback("team-1").requests["laws"].events]
    assert steps == ["asked", "answered", "reopened", "asked"]


@pytest.mark.parametrize(
    ("criterion", "why", "message"),
    [
        ("laws", " \n", "write what was judged wrongly"),
        ("laws", "", "write what was judged wrongly"),
        ("laws", "x" * (MOST_LETTERS + 1), "at most 1,000 characters, found 1,001"),
        ("nothing", "x", "only where points were lost"),
        ("", "x", "only where points were lost"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(book, criterion, why, message):
    """A request that makes no sense is refused, and nothing is stored."""
    with pytest.raises(RequestRefused, match=message):
        book.ask("team-1", criterion, why=why, by="s1")
    assert book.n_waiting() == 0


def test_a_criterion_with_all_points_cannot_be_asked_about(book):
    """A criterion with all its points cannot be asked about.

    A criterion that was never judged can be asked about, since its points are lost too.
    """
    finish(book, make_grade("team-1"), failed_grade("team-2", "no submission.toml"), key="new ")
    with pytest.raises(RequestRefused, match="points were lost"):
        book.ask("team-1", "laws", why="more", by="s1")
    book.ask("team-2", "laws", why="the file was in the zip", by="s2")
    answer(book, 0.5, text="found it")
    assert book.own_feedback("team-2").entry.grade.points == 0.5


def test_few_requests_wait_at_once(book):
    """A team can have only a few open requests; after an answer it can ask again."""
    for criterion in CRITERIA[:MOST_OPEN]:
        book.ask("team-1", criterion, why="x", by="s1")
    with pytest.raises(RequestRefused, match=f"{MOST_OPEN} of your requests are waiting"):
        book.ask("team-1", CRITERIA[MOST_OPEN], why="x", by="s1")
    book.ask("team-2", CRITERIA[MOST_OPEN], why="x", by="s2")
    answer(book, None)
    book.ask("team-1", CRITERIA[MOST_OPEN], why="x", by="s1")


def test_students_can_read_and_ask_only_while_released(place):
    """Students can read and ask only while their class is released."""
    with RequestGradebook(place, assignment="lab", create=True) as book:
        assert book.own_feedback("team-1") is None
        finish(book, make_grade("team-1", share=0.5))
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
        with pytest.raises(ConfigError, match="not the name of a submission"):
            book.own_feedback("s-team-1")  # s1 is an author
        with pytest.raises(ConfigError, match="no such submission"):
            book.own_feedback("team-9")
    with RequestGradebook(place, assignment="lab-2", create=True) as other:
        finish(other, make_grade("team-1", share=0.5), key="2 ")
        assert other.own_feedback("team-1") is None


def test_an_answer_to_a_changed_request_is_refused(book):
    """An answer is refused if the request has changed since the TA saw it.

    Another TA may have answered, points may have been given by hand, or a regrade may have run.
    """
    for criterion in ("laws", "pieces"):
        book.ask("team-1", criterion, why="x", by="s1")
    laws, pieces = book.queue().waiting
    give = {"text": "mine", "by": "Bob"}
    book.answer("team-1", "laws", 1.0, text="hers", by="Ada", version=laws.version)
    with pytest.raises(Conflict) as conflict:
        book.answer("team-1", "laws", 0.0, version=laws.version, **give)
    now = conflict.value.now
    assert now is not None
    assert (now.points, now.by) == (1.0, "Ada")
    book.override("team-1", "pieces", 0.75, why="seen", by="Ada")
    with pytest.raises(Conflict):
        book.answer("team-1", "pieces", 0.0, version=pieces.version, **give)
    (pieces,) = book.queue().waiting
    finish(book, make_grade("team-1", share=0.25), key="again ")
    with pytest.raises(Conflict):
        book.answer("team-1", "pieces", 0.0, version=pieces.version, **give)
    (settled,) = book.queue().settled
    with pytest.raises(RequestRefused, match="has an answer already"):
        book.answer("team-1", "laws", 0.0, version=settled.version, **give)
    with pytest.raises(RequestRefused, match="only an answered request"):
        book.reopen("team-1", "pieces", by="Bob", version=book.queue().waiting[0].version)
    with pytest.raises(ConfigError, match="expected 0 to 1 points"):
        answer(book, 99.0)
    with pytest.raises(RequestRefused, match="write an answer"):
        answer(book, 1.0, text=" ")
    events = book.history("team-1")[1]
    assert [e.what for e in events].count("answered") == 1
    assert [e.what for e in events].count("override") == 2


def test_only_one_of_two_simultaneous_answers_counts(book, place):
    """If two TAs answer a request at the same moment, only one answer counts.

    The other answer is refused as a conflict.
    """
    with RequestGradebook(place) as other:
        for number in range(10):
            book.ask("team-1", "laws", why=f"round {number}", by="s1")
            seen = book.queue().waiting[0].version
            ready = Barrier(2)

            points = 0.25 + 0.5 * (number % 2)  # points different from those of the round before

            def give(who, by, *, seen=seen, ready=ready, points=points):
                ready.wait()
                try:
                    who.answer("team-1", "laws", points, text=f"from {by}", by=by, version=seen)
                except Conflict:
                    return "conflict"
                return "taken"

            with ThreadPoolExecutor(2) as pool:
                one, two = pool.submit(give, book, "Ada"), pool.submit(give, other, "Bob")
                assert sorted([one.result(), two.result()]) == ["conflict", "taken"]
            book.reopen("team-1", "laws", by="Ada", version=book.queue().settled[0].version)
    what = [event.what for event in book.history("team-1")[1]]
    assert (what.count("answered"), what.count("override")) == (10, 10)


def test_only_one_of_two_simultaneous_requests_is_stored(book, place):
    """If two members of a team ask at the same moment, one request is stored, the other refused."""
    with RequestGradebook(place) as other:
        ready = Barrier(2)

        def ask(who, by):
            ready.wait()
            try:
                who.ask("team-1", "laws", why="x", by=by)
            except RequestRefused:
                return "refused"
            return "asked"

        with ThreadPoolExecutor(2) as pool:
            one, two = pool.submit(ask, book, "s1"), pool.submit(ask, other, "s2")
            assert sorted([one.result(), two.result()]) == ["asked", "refused"]


def test_a_request_goes_with_the_people(book):
    """A request stays with its authors when their team gets another name.

    Another team that now has the old name does not get it.
    """
    book.ask("team-1", "laws", why="see page 3", by="s1")
    moved = {"team-1": "group-1"}
    finish(book, make_grade("group-1", share=0.5, authors=("s-team-1",)), moved=moved, key="b ")
    (asked,) = book.queue().waiting
    assert (asked.entry.submission, asked.request.events[0].text) == ("group-1", "see page 3")
    answer(book, 1.0)
    finish(book, make_grade("group-1", share=0.5, authors=("someone",)), key="c ")
    assert (book.n_waiting(), book.own_feedback("group-1").requests) == (0, {})


def test_a_criterion_that_is_gone_can_still_be_answered(book):
    """If a criterion was removed, a request about it can be answered, but not with points."""
    book.ask("team-1", "laws", why="x", by="s1")
    less = tuple(c for c in RUBRIC.criteria if c.id != "laws")
    finish(
        book, make_grade("team-1", share=0.5), rubric=RUBRIC.model_copy(update={"criteria": less})
    )
    with pytest.raises(ConfigError, match="no such criterion"):
        answer(book, 1.0)
    answer(book, None, text="nobody loses points for it now")
    assert book.n_waiting() == 0


def test_an_anonymous_history_hides_who_asked(book):
    """An anonymous history hides who asked, even if the student's text contains a name."""
    anonymous = RUBRIC.model_copy(update={"anonymous": True})
    finish(book, make_grade("team-1", share=0.5), rubric=anonymous)
    book.ask("team-1", "laws", why="I, u42 of team-1 (S-team-1), see page 3", by="u42")
    shown = pseudonyms_in(book)["team-1"]
    text = history_text(*history_of(book, shown))
    assert not [name for name in ("u42", "team-1") if name in text.casefold()]
    assert "asked     laws: by the team: I, …" in text
    assert "u42" in history_text(*history_of(book, "team-1"))


def test_a_gradebook_without_requests_gets_them(tmp_path):
    """A gradebook written before requests existed gets the missing tables and keeps its rows."""
    with SharedGradebook(tmp_path, assignment="lab", create=True) as book:
        finish(book, make_grade("team-1", share=0.5))
    with closing(sqlite3.connect(tmp_path / FILE)) as old:
        for table in ("request_events", "releases"):
            old.execute(f"DROP TABLE {table}")
        old.commit()
    with RequestGradebook(tmp_path) as book:
        assert (book.n_waiting(), book.released) == (0, False)
        book.release(True, by="prof")
        book.ask("team-1", "laws", why="x", by="s1")
        answer(book, 1.0)
        assert book.entry("team-1").grade.points == 10.5


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_a_kill_leaves_an_answer_with_its_points_or_neither(tmp_path):
    """If the answering process is killed, an answer is stored with its points or not at all."""
    assert_whole(str(tmp_path), kills=8)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_in_postgresql_a_kill_leaves_an_answer_with_its_points_or_neither(place_in_postgresql):
    """In PostgreSQL too, a kill leaves an answer stored with its points or not at all."""
    assert_whole(place_in_postgresql, kills=8)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_a_hundred_kills_leave_no_half_of_an_answer(place):
    """After a hundred kills of the answering process, every stored answer has its points."""
    assert_whole(place, kills=100)


def assert_whole(place: str, *, kills: int) -> None:
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", place, str(kills), "answers"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    done, within, told, _ = map(int, re.findall(r"\d+", said.stdout))
    assert done == kills
    assert within > kills // 4  # most processes lived long enough to answer
    assert told >= within
