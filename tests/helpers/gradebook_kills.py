"""Kill a process again and again while it writes into a gradebook; report any loss.

python -m tests.helpers.gradebook_kills PLACE KILLS [answers]
python -m tests.helpers.gradebook_kills PLACE open|statements

A child process stores outcomes and confirms each through a pipe once `put` has returned. Afterwards
all confirmed outcomes must be stored completely. At most one more may be there, which the child
could not confirm in time.

With `answers`, the child answers requests instead, each with new points. An answer and its points
must both be stored, or neither.

With `open`, a process that opens the gradebook is killed before its first statement, then one
before its second, until one lives. With `statements`, so are processes that do what people do; each
must leave the gradebook as it was, until the whole is stored.
"""

import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from itertools import count

from sqlalchemy import Engine
from sqlalchemy.event import listen

from pipeline.grading.gradebook.decisions import WantedPoints
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from tests.helpers.grades import (
    book_of,
    finish,
    hertz_flag,
    make_grade,
    make_outcome,
    seen,
    two_cart_rubric,
)

_MOST_PUTS = 4  # largest number of outcomes to wait for before the kill
_LONGEST = 0.03  # longest further wait in s, as a put takes some milliseconds
_FIGURE = ("step.svg", "<svg>" + "0.123 " * 4000 + "</svg>")


def outcome_of(number: int):
    grade = make_grade(f"team-{number}", share=0.5, flags=(hertz_flag(),))
    return make_outcome(grade, figures=(_FIGURE,))


def put_until_killed(place: str, first: int, pipe: int) -> None:
    book = Gradebook(place, assignment="lab", create=True)
    number = first
    while True:
        book.put(outcome_of(number))
        os.write(pipe, f"{number}\n".encode())
        number += 1


def answer_until_killed(place: str, first: int, pipe: int) -> None:
    """Ask, answer with new points and reopen, again and again; confirm each round by its number."""
    book, number = Gradebook(place), first
    while True:
        asked = book.queue().waiting
        if not asked:
            for entry, done in book.queue().settled:
                if done.state == "answered":
                    version = entry.request_version("laws")
                    book.reopen("team", "laws", by="Ada", version=version)
            book.ask("team", "laws", why=f"reason {number}", by="s1")
            asked = book.queue().waiting
        points = number % 4 / 4  # multiples of the step, and less than all of the points
        version = asked[0][0].request_version("laws")
        book.answer("team", "laws", points, text=f"{number}", by="Ada", version=version)
        os.write(pipe, f"{number}\n".encode())
        number += 1


def kill_once(child_does: Callable[[int], None], rng: random.Random) -> list[bytes]:
    """Return the complete lines that a child wrote before it was killed."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ours)
        child_does(theirs)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        heard = [pipe.readline() for _ in range(rng.randint(0, _MOST_PUTS))]
        time.sleep(_LONGEST * rng.random())
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        heard += pipe.readlines()
    return [line for line in heard if line.endswith(b"\n")]


def kill_answers(place: str, kills: int) -> None:
    """Kill a process that answers requests; each stored answer must have its points."""
    outcome = make_outcome(make_grade("team", share=0.5))
    with Gradebook(place, assignment="lab", create=True) as book:
        book.put(outcome)
        book.finish(Batch(keys=(outcome.key,), shared={}), rubric=two_cart_rubric())
        book.release(True, by="prof")
    rng, told, killed_within = random.Random(7), 0, 0
    for _ in range(kills):
        first = told
        lines = kill_once(lambda pipe, n=first: answer_until_killed(place, n, pipe), rng)
        killed_within += bool(lines)
        told = int(lines[-1]) + 1 if lines else told
        with Gradebook(place) as book:
            events = book.history("team")[1]
        answers = [(e.points, e.text) for e in events if e.what == "answered"]
        given = [(e.points, e.text) for e in events if e.what == "override"]
        assert answers == given, (answers[-2:], given[-2:])
        numbers = [int(text) for _, text in answers]
        assert numbers[:told] == list(range(told)), told
        assert len(numbers) <= told + 1
        told = len(numbers)
    print(f"kills {kills} within {killed_within} told {told} there {told}")  # noqa: T201


def kill_before_statements(act: Callable[[], object]) -> Iterator[int]:
    """Do something in a child that is killed before a statement or a commit; yield its number.

    Each child lives one statement longer than the one before; the last one lives to its end.
    """
    for number in count():
        child = os.fork()
        if child == 0:
            _live_for(number, act)
        status = os.waitpid(child, 0)[1]
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            return
        yield number


def _live_for(statements: int, act: Callable[[], object]) -> None:
    left = count(statements, -1)

    def die(*_: object) -> None:
        if next(left) == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    for event in ("before_cursor_execute", "commit"):
        listen(Engine, event, die)
    try:
        act()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def kill_open(place: str) -> None:
    """Kill processes that open a gradebook, before each of their statements."""
    kills = list(kill_before_statements(lambda: Gradebook(place).close()))
    print(f"kills {len(kills)}")  # noqa: T201


def kill_acts(place: str) -> None:
    """Kill processes that do what people do, before each of their statements."""
    class_ = [make_grade(name, share=0.5) for name in ("team-1", "team-2")]
    new = make_outcome(make_grade("team-3", authors=("s-team-2",)), figures=(_FIGURE,))
    with book_of(place, *class_):
        pass

    def wish(team: str) -> WantedPoints:
        return WantedPoints(submission=team, criterion="laws", points=0.0, why="wrong")

    def asked(book: Gradebook) -> dict[str, str]:
        queue = book.queue()
        return {"by": "Ada", "version": seen([*queue.waiting, *queue.settled][0])}

    def listed(book: Gradebook) -> object:
        return finish(book, class_[0], new, moved={"team-2": "team-3"})

    team, about = "team-1", ("team-1", "laws")
    acts: dict[str, Callable[[Gradebook], object]] = {
        "release": lambda book: book.release(True, by="prof"),
        "override": lambda book: book.override(*about, 0.25, why="no", by="Ada"),
        "adjust": lambda book: book.adjust(team, -1.0, why="no", by="Ada"),
        "change_all": lambda book: book.change_all([wish("team-1"), wish("team-2")], by="Ada"),
        "undo_all": lambda book: book.undo_all(book.changed_together()[0].at, by="Ada"),
        "ask": lambda book: book.ask(*about, why="please", by="s1"),
        "answer": lambda book: book.answer(*about, 1.0, text="yes", **asked(book)),
        "reopen": lambda book: book.reopen(*about, **asked(book)),
        "review": lambda book: book.set_reviewed(team, by="Ada", reviewed=True),
        "put": lambda book: book.put(new),
        "finish": listed,
        "remove": lambda book: book.remove([team]),
    }
    for name, act in acts.items():
        before, kills = _view(place), 0

        def whole(act: Callable[[Gradebook], object] = act) -> None:
            with Gradebook(place, assignment="lab") as book:
                act(book)

        for _ in kill_before_statements(whole):
            kills += 1
            assert _view(place) == before, name
        assert _view(place) != before, name
        print(f"{name}: kills {kills}")  # noqa: T201


def _view(place: str) -> object:
    """Return all that a gradebook says of its class."""
    with Gradebook(place, assignment="lab") as book:
        listed = list(book.entries())
        history = [book.history(name) for name in ("team-1", "team-2")]
        return listed, history, book.released, book.known("key of team-3") is None


def main(place: str, kills: int) -> None:
    rng = random.Random(5)
    told, killed_within = 0, 0
    for _ in range(kills):
        first = told
        lines = kill_once(lambda pipe, n=first: put_until_killed(place, n, pipe), rng)
        told = int(lines[-1]) + 1 if lines else told
        killed_within += bool(lines)
        with Gradebook(place, assignment="lab", create=True) as book:
            for number in range(max(0, told - len(lines)), told):
                assert book.known(f"key of team-{number}") == outcome_of(number), number
            more = book.known(f"key of team-{told}")
            assert more in (None, outcome_of(told)), told
            told += more is not None
            assert book.known(f"key of team-{told}") is None, told
    with Gradebook(place, assignment="lab", create=True) as book:
        there = sum(1 for _ in book.fingerprints())
    print(f"kills {kills} within {killed_within} told {told} there {there}")  # noqa: T201


if __name__ == "__main__":
    if sys.argv[2] in ("open", "statements"):
        (kill_open if sys.argv[2] == "open" else kill_acts)(sys.argv[1])
    else:
        (kill_answers if "answers" in sys.argv else main)(sys.argv[1], int(sys.argv[2]))
