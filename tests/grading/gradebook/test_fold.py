"""Properties of the fold of a submission's events, and of each decision about it."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ConfigError
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook import decisions
from pipeline.grading.gradebook.decisions import WantedPoints
from pipeline.grading.gradebook.events import POINTS, TOTAL, Entry, Event
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.total import with_total
from tests.helpers.grades import book_of, make_grade, two_cart_rubric

RUBRIC = two_cart_rubric()
CRITERIA = ("pieces", "laws", "state-model")  # of 1, 1 and 2 points
PEOPLE = ((), ("ann",), ("bo",), ("ann", "bo"))

points = st.sampled_from([None, 0.0, 0.25, 0.5, 1.0])
texts = st.sampled_from(["a", "b", "c"])


@st.composite
def some_events(draw: st.DrawFn, most: int = 12) -> tuple[Event, ...]:
    """Return numbered events of any kind, also of people who are no authors any more."""
    made = []
    for number in range(1, draw(st.integers(0, most)) + 1):
        what: Any = draw(st.sampled_from(["override", "comment", "adjusted", "asked", "answered",
                                     "reopened", "reviewed", "unreviewed"]))  # fmt: skip
        about, given_points, grading = draw(st.sampled_from(CRITERIA)), None, None
        if what == "override":
            given_points = draw(points)
        if what == "adjusted":
            about, given_points = TOTAL, draw(st.sampled_from([-2.0, -0.5, 0.5]))
        if what.endswith("reviewed"):
            about, grading = "", draw(st.sampled_from([1, 2]))
        made.append(
            Event(what=what, criterion=about, points=given_points, text=draw(texts), by="Ada",
                  grading=grading, authors=draw(st.sampled_from(PEOPLE)), id=number)
        )  # fmt: skip
    return tuple(made)


@st.composite
def some_entries(draw: st.DrawFn) -> Entry:
    """Return a submission after some events."""
    grade = make_grade("team", share=0.5, days_late=draw(st.sampled_from([0.0, 1.0])))
    grade = with_total(grade, grade.criteria, rubric=RUBRIC)  # with the deduction for lateness
    return Entry(
        submission="team", rubric=RUBRIC, graded=grade, authors=draw(st.sampled_from(PEOPLE)),
        events=draw(some_events()), owner="", key="k", grading=1, first_key="k",
    )  # fmt: skip


def said(entry: Entry) -> tuple[object, ...]:
    """Return all that pages show of a submission, without numbers and times of events."""
    return (
        entry.grade,
        {id_: own.text for id_, own in {**entry.overrides, **entry.comments}.items()},
        {id_: [event.what for event in own.events] for id_, own in entry.requests.items()},
        entry.reviewed_by,
    )


def subject(event: Event) -> tuple[str, str]:
    """Return what an event is about; only the events about the same thing replace each other."""
    if event.what in POINTS:
        return ("points", event.criterion)
    return ("review", "") if event.grading else ("request", event.criterion)


@given(some_entries(), st.randoms(use_true_random=False))
@settings(max_examples=60, deadline=None)
def test_the_order_of_arrival_matters_only_for_the_same_thing(entry, random):
    """Events about different criteria, requests and reviews may arrive in any order."""
    own: dict[tuple[str, str], list[Event]] = {}
    for event in entry.events:
        own.setdefault(subject(event), []).append(event)
    mixed = []
    while left := [queue for queue in own.values() if queue]:
        mixed.append(random.choice(left).pop(0))
    assert said(replace(entry, events=tuple(mixed))) == said(entry)


@given(some_entries(), st.permutations([-2.0, -0.5, 0.5, 1.0]))
@settings(max_examples=30, deadline=None)
def test_adjustments_add_up_in_any_order(entry, changes):
    """All changes of the total count, whichever came first."""

    def total(order: list[float]) -> float:
        adjusted = (Event(what="adjusted", criterion=TOTAL, points=p, text="x") for p in order)
        return entry.after(*adjusted).grade.points

    assert total(changes) == total(sorted(changes))


@given(some_entries(), st.sampled_from([*CRITERIA, TOTAL]), points, texts, st.booleans())
@settings(max_examples=80, deadline=None)
def test_undo_takes_back_exactly_the_last_change(entry, criterion, wanted, why, comment):
    """After a change and its undo, all is as before; another undo brings the change back."""
    if criterion == TOTAL:
        wanted, comment = (wanted or -1.5), False
    elif comment:
        wanted = None
    asked = WantedPoints(
        submission="team", criterion=criterion, points=wanted, why=why, comment=comment
    )
    number = count(1_000)

    def do(entry: Entry, event: Event) -> Entry:
        return entry.after(replace(event, by="Bob", authors=entry.authors, id=next(number)))

    changed = do(entry, decisions.change(entry, asked))
    undone = do(changed, decisions.undo(changed, criterion))
    again = do(undone, decisions.undo(undone, criterion))

    if criterion == TOTAL:  # the adjustments stay listed, and their sum is the same
        assert undone.grade.points == entry.grade.points
        assert again.grade.points == changed.grade.points
    else:
        assert said(undone) == said(entry)
        assert said(again) == said(changed)
    assert undone.version(criterion) != entry.version(criterion)


def _act(book: Gradebook, what: str, criterion: str, value: float | None, why: str) -> None:
    """Do one thing as a person does it, with the version that the gradebook shows now."""
    entry = book.entry("team-1")
    seen, last = entry.version(criterion), entry.requests.get(criterion)
    about = "team-1", criterion
    wish = WantedPoints(submission="team-1", criterion=criterion, points=value, why=why)
    asked = entry.request_version(criterion) if last else ""
    acts: dict[str, Callable[[], object]] = {
        "override": lambda: book.override(*about, value, why=why, by="Ada"),
        "change": lambda: book.change(*about, value, why=why, by="Ada", version=seen),
        "stale": lambda: book.change(*about, value, why=why, by="Ada", version="1.999"),
        "undo": lambda: book.undo(*about, by="Ada", version=seen),
        "all": lambda: book.change_all([wish, replace(wish, submission="team-2")], by="Ada"),
        "ask": lambda: book.ask(*about, why=why, by="s1"),
        "answer": lambda: book.answer(*about, value, text=why, by="Ada", version=asked),
        "reopen": lambda: book.reopen(*about, by="Ada", version=asked),
        "accept": lambda: book.set_reviewed("team-1", by="Ada", reviewed=True),
        "unsigned": lambda: book.override(*about, value, why=why, by=" "),
        "preview": lambda: book.preview_all([wish]),
    }
    acts[what]()


ACTS = st.tuples(
    st.sampled_from(["override", "change", "stale", "undo", "all", "ask", "answer", "reopen",
                     "accept", "unsigned", "preview"]),
    st.sampled_from(CRITERIA),
    st.sampled_from([None, 0.0, 0.25, 0.3, 0.5, 1.0, 7.0]),  # 0.3 and 7 points are refused
    texts,
)  # fmt: skip


@given(st.lists(ACTS, min_size=4, max_size=12))
@settings(max_examples=8, deadline=None)
def test_nothing_changes_without_an_event(acts):
    """What the gradebook says changes only with new events, and a refused act adds none.

    The events that are stored give the same grade as the ones in memory.
    """
    grades: list[Grade] = [make_grade(name, share=0.5) for name in ("team-1", "team-2")]
    with TemporaryDirectory() as place, book_of(place, *grades) as book:
        book.release(True, by="prof")
        for act in acts:
            (before, *others), state = list(book.entries()), book.state()
            refused = False
            try:
                _act(book, *act)
            except ConfigError:
                refused = True
            (after, *others_after), changed = list(book.entries()), book.state() != state
            if refused or act[0] == "preview":
                assert not changed
            if not changed:
                assert ([after, *others_after]) == [before, *others]
            new = after.events[len(before.events) :]
            assert after.events[: len(before.events)] == before.events  # in place
            assert said(before.after(*new)) == said(after)
