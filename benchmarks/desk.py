"""How fast the desk shows a class: CPU time of the server for a page, from a cold start and warm.

    python -m benchmarks.desk [--teams 2000] [--anonymous]

The grades are made up, as large as real ones: 14 criteria, two flags, 12 kB each; every tenth team
has points given by hand, and every 20th shares a recording.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Batch
from tests.helpers.desks import Visitor
from tests.helpers.grades import (
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

_REPEATS = 9
_PADDING = 600  # letters in a criterion's message


def write_book(folder: Path, teams: int, *, anonymous: bool) -> None:
    """Write a gradebook of so many teams."""
    names = [f"team-{n:04d}" for n in range(teams)]
    with Gradebook(folder, assignment="lab", create=True) as book:
        for n, name in enumerate(names):
            grade = make_grade(name, share=1 - (n % 10) / 10, days_late=float(n % 3 == 0))
            criteria = (c.model_copy(update={"message": "x" * _PADDING}) for c in grade.criteria)
            flags = (hertz_flag(),) * (n % 4 == 0)
            grade = grade.model_copy(update={"criteria": tuple(criteria), "flags": flags})
            book.put(make_outcome(grade))
        shared = {}
        for n in range(0, teams - 1, 20):
            shared[names[n]] = shared_flag(names[n + 1])
            shared[names[n + 1]] = shared_flag(names[n])
        rubric = two_cart_rubric().model_copy(update={"anonymous": anonymous})
        book.finish(Batch(keys=tuple(f"key of {n}" for n in names), shared=shared), rubric=rubric)
        for name in names[::10]:
            book.override(name, "laws", 1.0, why="explained well", by="Ada")


def cpu(ask: Callable[[], object]) -> float:
    """Return the CPU seconds of this process, in which the server runs, for one request."""
    before = time.process_time()
    ask()
    return time.process_time() - before


def main() -> None:
    """Print a line for each page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--teams", type=int, default=2000)
    parser.add_argument("--anonymous", action="store_true")
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "grades"
        folder.mkdir()
        write_book(folder, told.teams, anonymous=told.anonymous)
        with DeskServer() as server:
            visitor = Visitor.of(server.url)
            assert visitor.post("/open", folder=str(folder)).status == 303
            pages = {
                "the class": "/grades/0/",
                "a filter": "/grades/0/?flag=hz_for_rad_s&lost=laws",
                "a search": "/grades/0/?q=1999",
                "not yet looked at": "/grades/0/?seen=no&page=3",
                "what is new": "/grades/0/news?since=0&told=0",
                "the histogram": "/grades/0/distribution.svg",
                "the class page": "/grades/0/class.html",
            }
            first = cpu(lambda: visitor.get("/grades/0/"))
            print(f"first paint, gradebook opened and all read: {1e3 * first:.0f} ms")
            for what, path in pages.items():
                assert visitor.get(path).status == 200, path
                spent = sorted(cpu(lambda path=path: visitor.get(path)) for _ in range(_REPEATS))
                print(f"{what}: {1e3 * spent[_REPEATS // 2]:.0f} ms, at most {1e3 * spent[-1]:.0f}")
            changed = visitor.post("/grades/0/team?of=team-0001", do="accept", by="Ada")
            assert changed.status == 303
            print(
                f"the class after a change: {1e3 * cpu(lambda: visitor.get('/grades/0/')):.0f} ms"
            )


if __name__ == "__main__":
    main()
