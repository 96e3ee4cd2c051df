"""Kill a process again and again while it writes into a gradebook; report any loss.

python -m tests.helpers.gradebook_kills PLACE KILLS [answers]

A child process stores outcomes and confirms each through a pipe once `put` has returned. Afterwards
all confirmed outcomes must be stored completely. At most one more may be there, which the child
could not confirm in time.

With `answers`, the child answers requests instead, each with new points. An answer and its points
must both be stored, or neither.
"""

import os
import random
import signal
import sys
import time
from collections.abc import Callable

from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.request_gradebook import RequestGradebook
from pipeline.grading.gradings import Batch
from tests.helpers.grades import hertz_flag, make_grade, make_outcome, two_cart_rubric

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
    book, number = RequestGradebook(place), first
    while True:
        asked = book.queue().waiting
        if not asked:
            for done in book.queue().settled:
                if done.request.state == "answered":
                    book.reopen("team", "laws", by="Ada", version=done.version)
            book.ask("team", "laws", why=f"reason {number}", by="s1")
            asked = book.queue().waiting
        points = number % 4 / 4  # multiples of the step, and less than all of the points
        book.answer("team", "laws", points, text=f"{number}", by="Ada", version=asked[0].version)
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
    with RequestGradebook(place, assignment="lab", create=True) as book:
        book.put(outcome)
        book.finish(Batch(keys=(outcome.key,), shared={}), rubric=two_cart_rubric())
        book.release(True, by="prof")
    rng, told, killed_within = random.Random(7), 0, 0
    for _ in range(kills):
        first = told
        lines = kill_once(lambda pipe, n=first: answer_until_killed(place, n, pipe), rng)
        killed_within += bool(lines)
        told = int(lines[-1]) + 1 if lines else told
        with RequestGradebook(place) as book:
            events = book.history("team")[1]
        answers = [(e.points, e.text) for e in events if e.what == "answered"]
        given = [(e.points, e.text) for e in events if e.what == "override"]
        assert answers == given, (answers[-2:], given[-2:])
        numbers = [int(text) for _, text in answers]
        assert numbers[:told] == list(range(told)), told
        assert len(numbers) <= told + 1
        told = len(numbers)
    print(f"kills {kills} within {killed_within} told {told} there {told}")  # noqa: T201


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
    (kill_answers if "answers" in sys.argv else main)(sys.argv[1], int(sys.argv[2]))
