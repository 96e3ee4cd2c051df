"""Run a lab server for half an hour and a bench for two hours; check data, memory and times.

    python -m benchmarks.endurance class [--minutes 30] [--teams 300]
    python -m benchmarks.endurance exploration [--hours 2]
    python -m benchmarks.endurance page

The first two commands write endurance.json, and the last writes endurance.md. With `--quick`, the
first two take about a minute each and only print. All random choices come from a seed, and servers
listen at 127.0.0.1 only. The class needs PostgreSQL.
"""

import argparse
import json
import os
import random
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import psutil
from sqlalchemy import create_engine, text

from benchmarks.endurance_checks import Found, check_book, check_folders
from benchmarks.endurance_people import Assistant, Files, Journal, Lab, Person, Student
from benchmarks.page import machine
from pipeline.experiments.plan import load_plan, session_time
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.judge.award import findings_text
from pipeline.grading.judge.run import under_rubric
from pipeline.grading.publish.feedback_figures import draw_figures, draw_records
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.output import write_file
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers import postgres
from tests.helpers.benches import emulator
from tests.helpers.desks import write_users
from tests.helpers.grades import make_outcome
from tests.helpers.grading_students import Student as Reporter
from tests.helpers.waiting import PATIENCE, kill, until

KEPT = Path(__file__).with_name("endurance.json")
PAGE = Path(__file__).with_name("endurance.md")
PRESET, ASSIGNMENT = "throne-2dof", "lab"
SLIPS = (1.1, 0.9, 2.0, 0.5, 1 / (2 * np.pi), 100.0)  # factors of wrong numbers
# After a start, memory rises for some seconds, because of imports, caches and cycles of dead
# objects. Such cycles are collected only after 300,000 new objects.
SETTLING = 480.0
BLOCK = 60.0  # s over which memory is averaged, because neighbouring samples are not independent
KILLED = {"desk": 5, "worker": 3, "connection": 2}  # relative frequencies
FOLDERS = 4  # folders of each student


@dataclass(frozen=True, kw_only=True)
class Size:
    """The size of a run of the class; `rest` is the mean time between two kills in s."""

    minutes: float
    teams: int
    students: int
    bases: int
    rest: float
    sample: float = 2.0
    pace: float = 1.0


# ------------------------------------------------------------------------------ the class


def graded_class(place: str, size: Size, *, folder: Path, seed: int) -> list[Files]:
    """Grade a class into a gradebook and release it; return the recordings of each base submission.

    A few simulated submissions, called bases, are analysed. Each team reports one base's numbers
    with some mistakes, and is graded on them. Its feedback has that base's figures.
    """
    rubric, draw = load_rubric(Path(PRESET)), random.Random(f"{seed} class")
    bases = [_base(folder / f"base-{n}", rubric, seed=seed + n) for n in range(size.bases)]
    keys = []
    with Gradebook(place, assignment=ASSIGNMENT, create=True) as book:
        for number, name in enumerate(team_names(size.teams)):
            base, figures, prints = bases[number % size.bases]
            graded = _with_slips(base, draw).graded(days_late=draw.choice([0, 0, 0, 1.5]))
            named = {"submission": name, "authors": (f"s-{name}",)}
            outcome = make_outcome(
                graded.grade.model_copy(update=named),
                findings=findings_text(graded.judgements),
                figures=figures,
                fingerprints=prints,
            )
            book.put(outcome)
            keys.append(outcome.key)
        book.finish(Batch(keys=tuple(keys), shared={}), rubric=rubric)
        book.release(True, by="prof")
    return [
        [(path.name, path.read_bytes()) for path in sorted((base / "data").iterdir())]
        for base in (folder / f"base-{n}" for n in range(size.bases))
    ]


def team_names(many: int) -> list[str]:
    """Return the names of the teams."""
    return [f"team-{number:03d}" for number in range(1, many + 1)]


def _base(folder: Path, rubric: Rubric, *, seed: int) -> tuple[Reporter, Any, bytes]:
    folder.mkdir(parents=True)
    write_submission(folder, PRESET, seed=seed, compact=True, reported=True)
    submission, _ = under_rubric(load_submission(folder), rubric)
    analysis = analyse(submission, design=False)
    base = Reporter(submission=submission, analysis=analysis, rubric=rubric)
    drawn = draw_figures(analysis, submission.reported)
    initial = [c for c in base.grade().criteria if c.id.startswith("initial")]
    return base, drawn + draw_records(analysis, initial), fingerprint(analysis.records)


def _with_slips(base: Reporter, draw: random.Random) -> Reporter:
    """Return the base submission with one to five wrong numbers."""
    wrong: dict[str, dict[str, Decimal]] = {"initial": {}, "final": {}}
    for _ in range(draw.randint(1, 5)):
        table = draw.choice(["initial", "final"])
        name = draw.choice(sorted(getattr(base.reported, table)))
        number = base.value(table, name) * draw.choice(SLIPS)
        wrong[table][name] = Decimal(f"{number:.4g}")
    return base.reporting(initial=wrong["initial"], final=wrong["final"])


# ------------------------------------------------------------------------------- the desk


@dataclass(kw_only=True)
class Memory:
    """Resident memory of some processes in MB, and the time since the start in s."""

    at: list[float] = field(default_factory=list)
    mb: list[float] = field(default_factory=list)

    def add(self, at: float, processes: Sequence[psutil.Process]) -> None:
        """Record the memory of the processes now; an ended process counts as 0."""
        total = 0.0
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                total += process.memory_info().rss / 1e6
        self.at.append(at)
        self.mb.append(total)

    def slope(self, since: float) -> dict[str, float]:
        """Return the slope of memory in MB per hour, its standard error, median and maximum."""
        t, mb = np.array(self.at), np.array(self.mb)
        kept = t >= since
        t, mb = t[kept], mb[kept]
        if not t.size:
            return {"slope": np.nan, "std": np.nan, "median": np.nan, "most": np.nan, "hours": 0.0}
        block = ((t - since) // BLOCK).astype(int)
        pairs = [(t[block == b].mean(), mb[block == b].mean()) for b in np.unique(block)]
        slope = std = np.nan
        if len(pairs) > 3:
            middle, mean = np.transpose(pairs)
            (slope, _), covariance = np.polyfit(middle, mean, 1, cov=True)
            std = np.sqrt(covariance[0, 0])
        return {
            "slope": 3600 * float(slope),
            "std": 3600 * float(std),
            "median": float(np.median(mb)),
            "most": float(mb.max()),
            "hours": float(t[-1] - since) / 3600,
        }


@dataclass(kw_only=True)
class Server:
    """The desk of a lab server in its own process, killed and started again at the same port."""

    users: Path
    port: int
    log: Path
    process: subprocess.Popen[bytes] | None = None
    outlived: int = 0  # processes of a killed desk that did not end by themselves

    def start(self) -> None:
        """Start the desk and wait until it listens."""
        command = [sys.executable, "-m", "pipeline", "desk", "--host", "127.0.0.1", "--users"]
        command += [str(self.users), "--port", str(self.port), "--no-browser"]
        with self.log.open("ab") as log:
            began = log.tell()
            self.process = subprocess.Popen(command, stderr=log)

        def ready() -> bool:
            said = self.log.read_bytes()[began:]
            assert self.process is not None
            assert self.process.poll() is None, said.decode()
            return b"ready: " in said

        until(ready, "the desk")

    def tree(self) -> tuple[list[psutil.Process], list[psutil.Process]]:
        """Return the process of the desk, and those of its workers."""
        assert self.process is not None
        own = psutil.Process(self.process.pid)
        workers = [
            child
            for child in own.children(recursive=True)
            if any("pipeline.desk.tasks" in word for word in _words(child))
        ]
        return [own], workers

    def kill(self) -> None:
        """Kill only the desk, and count its child processes that do not end by themselves."""
        assert self.process is not None
        children = psutil.Process(self.process.pid).children(recursive=True)
        self.process.kill()
        self.process.wait()
        left = psutil.wait_procs(children, timeout=PATIENCE)[1]
        self.outlived += len(left)

    def stop(self) -> float:
        """End the desk as an administrator does, and return how long this took in s."""
        assert self.process is not None
        began = time.monotonic()
        self.process.terminate()
        self.process.wait(PATIENCE)
        return time.monotonic() - began


def _words(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def write_lab(base: Path, place: str, *, students: int) -> Path:
    """Make the folders of a lab and the file of its users; return the file."""
    users = [_user(name, "ta", gradebooks=[place]) for name in ("Ada", "Bob")]
    for number, team in enumerate(team_names(students)):
        folders = [student_folder(number, k) for k in range(FOLDERS)]
        for folder in folders:
            (base / folder).mkdir(parents=True)
        own = (
            f'grades = [{{ gradebook = "{place}", submission = "{team}", '
            f'assignment = "{ASSIGNMENT}" }}]\n'
        )
        users.append(_user(f"s{number}", "student", folders=folders) + own)
    return write_users(base, "".join(users))


def student_folder(number: int, k: int) -> str:
    """Return the folder for a student's recordings."""
    return f"s{number}-{k}"


def _user(name: str, role: str, **places: Sequence[str]) -> str:
    listed = "".join(f"{key} = {json.dumps(list(value))}\n" for key, value in places.items())
    return f'[[users]]\nname = "{name}"\nrole = "{role}"\n{listed}'


# ------------------------------------------------------------------------------ the kills


def kill_something(server: Server, lab: Lab, place: str, *, what: str, draw: random.Random) -> bool:
    """Kill the desk, a worker or a connection; return whether there was one to kill."""
    if what == "desk":
        lab.up.clear()
        server.kill()
        server.start()
        lab.up.set()
        return True
    if what == "worker":
        workers = server.tree()[1]
        if workers:
            with suppress(psutil.NoSuchProcess):
                draw.choice(workers).kill()
        return bool(workers)
    engine = create_engine(place.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        mine = "select pid from pg_stat_activity where pid <> pg_backend_pid() "
        mine += "and backend_type = 'client backend'"
        found = [row.pid for row in connection.execute(text(mine))]
        if found:
            end = text("select pg_terminate_backend(:pid)")
            connection.execute(end, {"pid": draw.choice(found)})
    engine.dispose()
    return bool(found)


# ------------------------------------------------------------------------------ the runs


def run_class(size: Size, *, seed: int) -> dict[str, Any]:
    """Let a class be graded while students upload and processes are killed; return the findings."""
    with tempfile.TemporaryDirectory() as scratch, postgres.running() as place:
        base = Path(scratch)
        os.environ["XDG_STATE_HOME"] = str(base / "state")  # for the desk's log
        recordings = graded_class(place, size, folder=base / "bases", seed=seed)
        users = write_lab(base, place, students=size.students)
        lab = Lab(port=_free_port(), teams=team_names(size.teams), pace=size.pace)
        server = Server(users=users, port=lab.port, log=base / "desk.log")
        people: list[Person] = [Assistant(name, lab, seed=seed) for name in ("Ada", "Bob")]
        people += [
            Student(
                f"s{number}",
                lab,
                team=team,
                recordings=recordings[number % size.bases],
                folders=FOLDERS,
                seed=seed,
            )
            for number, team in enumerate(team_names(size.students))
        ]
        with _running(server):
            watched = _watch(server, lab, people, place, size=size, seed=seed)
            stopped = server.stop()
        found = Found()
        folders = {
            (f"s{number}", str(k)): base / student_folder(number, k)
            for number in range(size.students)
            for k in range(FOLDERS)
        }
        check_book(place, lab.journal, teams=lab.teams, found=found)
        check_folders(folders, lab.journal, found=found)
        said = _count_said(server.log)
    return {
        "minutes": size.minutes,
        "teams": size.teams,
        "students": size.students,
        "seed": seed,
        "confirmed": {kind: lab.journal.confirmed(kind) for kind in _kinds(lab.journal)},
        "sent": len(lab.journal.sent),
        "lost": found.lost,
        "doubled": found.doubled,
        "spoilt": found.spoilt,
        "refused": Counter(f"{status} {page}" for status, page, _ in lab.journal.refused),
        "wrong": [wrong for status, _, wrong in lab.journal.refused if status >= 500][:20],
        "refused_said": Counter(wrong for _, _, wrong in lab.journal.refused).most_common(12),
        "outlived": server.outlived,
        "stopped": stopped,
        "said": said,
        "pages": _page_times(lab.journal),
        "machine": machine(),
        **watched,
    }


@contextmanager
def _running(server: Server) -> Iterator[None]:
    server.start()
    try:
        yield
    finally:
        if server.process is not None:
            kill(server.process)


def _watch(
    server: Server, lab: Lab, people: Sequence[Person], place: str, *, size: Size, seed: int
) -> dict[str, Any]:
    """Let people work while processes are killed; return kills, memory and load.

    In the first half anything is killed at random. In the second half only workers and connections
    are, so that the memory of one desk is observed for long enough.
    """
    draw, kills = random.Random(f"{seed} kills"), Counter()
    desk, workers, load = Memory(), Memory(), []
    length = 60 * size.minutes
    for person in people:
        person.start()
    lab.up.set()
    began = last_start = time.monotonic()
    next_kill = draw.expovariate(1 / size.rest)
    while (now := time.monotonic() - began) < length:
        own, others = server.tree()
        desk.add(now, own)
        workers.add(now, others)
        load.append(os.getloadavg()[0])
        if now >= next_kill:
            kinds = [kind for kind in KILLED if kind != "desk" or now < length / 2]
            what = draw.choices(kinds, [KILLED[kind] for kind in kinds])[0]
            kills[what] += kill_something(server, lab, place, what=what, draw=draw)
            if what == "desk":
                last_start = time.monotonic()
            next_kill = time.monotonic() - began + draw.expovariate(1 / size.rest)
        if faults := [person.fault for person in people if person.fault]:
            raise faults[0]
        time.sleep(size.sample)
    lab.over.set()
    for person in people:
        person.join(PATIENCE)
    since = last_start - began + min(SETTLING, length / 4)
    return {
        "kills": dict(kills),
        "memory": {"desk": desk.slope(since), "workers": workers.slope(since)},
        "trace": {
            "at": np.round(desk.at[::15], 1).tolist(),
            "desk": np.round(desk.mb[::15], 1).tolist(),
            "workers": np.round(workers.mb[::15], 1).tolist(),
        },
        "load": [float(np.median(load)), max(load)],
    }


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def _kinds(journal: Journal) -> list[str]:
    return sorted({change.kind for change in journal.sent})


def _count_said(log: Path) -> dict[str, int]:
    """Return how often the desk wrote a traceback."""
    return {"tracebacks": log.read_text(encoding="utf-8", errors="replace").count("Traceback")}


def _page_times(journal: Journal) -> dict[str, dict[str, float]]:
    """Return each page's number of answers, and statistics of their times in s."""
    times: Mapping[str, list[float]] = defaultdict(list)
    for page, seconds in journal.times:
        times[page].append(seconds)
    return {
        page: {
            "count": len(took),
            "median": float(np.median(took)),
            "p99": float(np.quantile(took, 0.99)),
            "most": max(took),
            "over": sum(one > 1 for one in took),
        }
        for page, took in sorted(times.items())
    }


def run_exploration(*, hours: float, speed: float, seed: int) -> dict[str, Any]:
    """Explore a fast virtual bench until its time is up; return its memory over time.

    The goal is unreachable, so that only the time limit ends the exploration.
    """
    memory, load = Memory(), []
    allowed = 3600 * hours
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "work"
        options = ("--speed", str(speed), "--seed", str(seed), "--hide", "coulomb_friction")
        with emulator(*options, preset="throne-1dof") as bench:
            command = [sys.executable, "-m", "pipeline", "explore", str(folder), "--yes"]
            command += ["--port", bench.address, "--until", "zeta 0.0001%"]
            command += ["--time", f"{allowed:.0f}s"]
            began = time.monotonic()
            with subprocess.Popen(command, stderr=subprocess.PIPE, encoding="utf-8") as process:
                said: list[str] = []
                assert process.stderr is not None
                reader = threading.Thread(target=said.extend, args=(process.stderr,))
                reader.start()
                own = psutil.Process(process.pid)
                try:
                    while process.poll() is None:
                        memory.add(time.monotonic() - began, [own])
                        load.append(os.getloadavg()[0])
                        time.sleep(1.0)
                finally:
                    kill(process)
                    reader.join()
        seconds = time.monotonic() - began
        submission = load_submission(folder)
        made = {experiment.id for experiment in submission.experiments}
        spent = session_time([one for one in load_plan(submission).recordings if one.id in made])
    turns = re.search(r"(\d+) turns", "".join(said))
    return {
        "hours": hours,
        "speed": speed,
        "seed": seed,
        "bench_seconds": spent,
        "seconds": seconds,
        "recordings": len(made),
        "turns": int(turns[1]) if turns else 0,
        "status": process.returncode,
        "last": [line.strip().replace(str(folder), "DIR") for line in said[-2:]],
        "memory": memory.slope(min(SETTLING, seconds / 4)),
        "trace": {"at": np.round(memory.at[::15], 1).tolist(), "mb": memory.mb[::15]},
        "load": [float(np.median(load)), max(load)],
        "machine": machine(),
    }


# ------------------------------------------------------------------------------- the page

KINDS = {
    "points": "points or comments",
    "together": "decisions for several teams",
    "request": "requests",
    "answer": "answers",
    "reopened": "reopened requests",
    "upload": "recordings",
    "row": "saved rows",
}
KILLS = {"desk": "the desk", "worker": "one of its workers", "connection": "a database connection"}
QUICK = Size(minutes=0.75, teams=12, students=3, bases=1, rest=12.0, sample=0.5, pace=5.0)


def main() -> None:
    """Run one part, or write the page from the parts that were run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("class", "exploration", "page"))
    parser.add_argument("--minutes", type=float, default=30.0, help="of the class")
    parser.add_argument("--teams", type=int, default=300)
    parser.add_argument("--hours", type=float, default=2.0, help="of the exploration, at the bench")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="small, to see that all runs")
    asked = parser.parse_args()
    if asked.part == "page":
        write_page()
        return
    if asked.part == "class":
        if why := postgres.missing():
            parser.error(why)
        full = Size(minutes=asked.minutes, teams=asked.teams, students=20, bases=6, rest=45.0)
        made = run_class(QUICK if asked.quick else full, seed=asked.seed)
    else:
        hours = 0.02 if asked.quick else asked.hours
        made = run_exploration(hours=hours, speed=20.0, seed=asked.seed)
    if asked.quick:
        print(json.dumps(made, indent=1))
        sys.exit(failed(made))
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    write_file(KEPT, json.dumps(kept | {asked.part: made}, indent=1) + "\n")


def failed(made: Mapping[str, Any]) -> bool:
    """Return whether a change was lost, doubled or damaged, or an exploration took too long."""
    wrong = (made.get(key) for key in ("lost", "doubled", "spoilt", "outlived"))
    return any(wrong) or made.get("bench_seconds", 0.0) > 3600 * made.get("hours", 0.0)


def write_page() -> None:
    """Write the stored results into the page, between its marks."""
    kept, page = json.loads(KEPT.read_text(encoding="utf-8")), PAGE.read_text(encoding="utf-8")
    parts = {
        "class": class_words(kept["class"]) if "class" in kept else "",
        "pages": page_table(kept["class"]["pages"]) if "class" in kept else "",
        "exploration": exploration_words(kept["exploration"]) if "exploration" in kept else "",
    }
    for name, words in parts.items():
        between = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        if name != "pages":
            words = "\n".join(
                fill(line, 119, subsequent_indent="  ") for line in words.splitlines()
            )
        page = between.sub(lambda found, w=words: f"{found[1]}{w}{found[2]}", page, count=1)
    write_file(PAGE, page)


def class_words(made: Mapping[str, Any]) -> str:
    """Return the result of the class as a list."""
    confirmed = ", ".join(f"{KINDS[kind]} {many:,}" for kind, many in made["confirmed"].items())
    killed = ", ".join(f"{KILLS[what]} {many}×" for what, many in made["kills"].items())
    total = sum(made["confirmed"].values())
    wrong = [len(made[key]) for key in ("lost", "doubled", "spoilt")]
    return "\n".join(
        [
            f"- **{total:,} confirmed changes** ({confirmed}): {wrong[0]} lost, "
            f"{wrong[1]} doubled, {wrong[2]} damaged.",
            f"- Killed: {killed}. {made['outlived']} processes outlived their desk.",
            f"- Memory of the desk: {memory_words(made['memory']['desk'])}; "
            f"of its workers together at most {made['memory']['workers']['most']:.0f} MB.",
            f"- {made['teams']} teams, {made['students']} students and 2 TAs for "
            f"{made['minutes']:g} minutes. {load_words(made)}",
        ]
    )


def exploration_words(made: Mapping[str, Any]) -> str:
    """Return how an exploration ended and how much memory it took."""
    return "\n".join(
        [
            f"- {made['bench_seconds'] / 60:.0f} minutes at the bench of "
            f"{60 * made['hours']:.0f} allowed, {made['recordings']} recordings, in "
            f"{made['seconds'] / 60:.0f} minutes.",
            f"- Memory: {memory_words(made['memory'])}.",
            f"- {load_words(made)}",
        ]
    )


def memory_words(seen: Mapping[str, float]) -> str:
    """Return the median, maximum and slope of memory use in words."""
    return (
        f"median {seen['median']:.0f} MB, most {seen['most']:.0f} MB, slope {seen['slope']:+.0f} ± "
        f"{seen['std']:.0f} MB an hour, over {60 * seen['hours']:.0f} minutes"
    )


def load_words(made: Mapping[str, Any]) -> str:
    """Return a description of the machine and its load."""
    middle, most = made["load"]
    return f"Load average {middle:.1f} (most {most:.1f}) on {made['machine']}."


def page_table(pages: Mapping[str, Mapping[str, float]]) -> str:
    """Return a Markdown table of answer times: a row per slow page, and one for all other pages."""
    lines = [
        "| page or form | answers | median | 99 % | most | over 1 s |",
        "|---|---|---|---|---|---|",
    ]
    slow = {page: took for page, took in pages.items() if took["over"] > 0.1 * took["count"]}
    for page, took in sorted(slow.items(), key=lambda one: -one[1]["median"]):
        seconds = " | ".join(f"{took[key]:.2f} s" for key in ("median", "p99", "most"))
        lines.append(f"| {page} | {took['count']:,} | {seconds} | {took['over']} |")
    others = [took for page, took in pages.items() if page not in slow]
    if others:
        count, over = (sum(took[key] for took in others) for key in ("count", "over"))
        most = [max(took[key] for took in others) for key in ("median", "p99", "most")]
        seconds = " | ".join(f"at most {one:.2f} s" for one in most)
        name = f"{len(others)} others" if slow else f"all {len(others)}"
        lines.append(f"| {name} | {count:,} | {seconds} | {over} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
