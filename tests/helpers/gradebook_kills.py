"""Kill a process again and again while it puts grades into a gradebook; say what was lost.

    python -m tests.helpers.gradebook_kills PLACE KILLS

A child puts outcomes in and tells each through a pipe once `put` has returned. What it told must
be there afterwards, whole, and beside it at most the one that it had no time to tell.
"""

import os
import random
import signal
import sys
import time

from pipeline.grading.gradebook.book import Gradebook
from tests.helpers.grades import hertz_flag, make_grade, make_outcome

_MOST_PUTS = 4  # that are waited for
_LONGEST = 0.03  # s after that: a put takes some milliseconds
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


def main(place: str, kills: int) -> None:
    rng = random.Random(5)
    told, killed_within = 0, 0
    for _ in range(kills):
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ours)
            put_until_killed(place, told, theirs)
        os.close(theirs)
        with os.fdopen(ours, "rb") as pipe:
            heard = [pipe.readline() for _ in range(rng.randint(0, _MOST_PUTS))]
            time.sleep(_LONGEST * rng.random())
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            heard += pipe.readlines()
        lines = [line for line in heard if line.endswith(b"\n")]
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
        there = sum(1 for _ in book.prints())
    print(f"kills {kills} within {killed_within} told {told} there {there}")  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
