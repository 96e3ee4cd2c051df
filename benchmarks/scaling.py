"""From one class to a million submissions, by measured costs and a simulated cluster.

    python -m benchmarks.scaling measure [--teams 6]    # some minutes; keeps scaling.json
    python -m benchmarks.scaling page                   # simulates, writes benchmarks/scaling.md

Times are processor times, which other work on the machine lengthens only through shared memory and
caches. The simulation draws its service times from the measured ones.
"""

import argparse
import heapq
import json
import re
import tempfile
import time
from collections import deque
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.copies import disguised
from benchmarks.grading_batch import grade, write_class
from benchmarks.page import significant
from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.gradings import Grading, HandIn
from pipeline.grading.intake.files import packed
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.similarity.copies import find_copies
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.read import read_data
from pipeline.output import write_file
from pipeline.submission import load_submission

COSTS = Path(__file__).with_name("scaling.json")
PAGE = Path(__file__).with_name("scaling.md")
PRESETS = ("throne-1dof", "throne-2dof", "throne-3dof")
COMPARED = (50, 100, 200, 400)  # numbers of submissions
NIGHT = 8 * 3600.0  # s
HOUR = 3600.0
PRICES = (0.02, 0.05)  # per core-hour in a rented cluster, in dollars or euros

# ------------------------------------------------------------------------------- costs


def measure(*, teams: int) -> dict[str, Any]:
    """Return the cost of one submission: worker, client, comparison, bytes."""
    costs: dict[str, Any] = {"seconds": {}}
    records, sizes, packing = [], [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        for preset in PRESETS:
            write_class(base / preset, teams, preset=preset)
            rubric, seconds = load_rubric(Path(preset)), []
            for number, team in enumerate(sorted((base / preset).iterdir())):
                task = HandIn(id=team.name, key=team.name, sources=(team,))
                start = time.process_time()
                grading = grade_hand_in(task, rubric=rubric, scratch=base)
                if number:  # the first task also loads code that all tasks use
                    seconds.append(round(time.process_time() - start, 3))
                book = len(grading.grade) + len(grading.fingerprints)
                start = time.process_time()
                sizes.append((len(packed([team])), book))
                packing += time.process_time() - start
                records.append(read_data(load_submission(team)).records)
            costs["seconds"][preset] = seconds
        handed_in, kept = np.mean(sizes, axis=0)
        costs |= {"handed_in": round(handed_in), "kept": round(kept)}
        costs["pack"] = round(packing / len(sizes), 4)  # needed only on a cluster
        # The client process hashes, sends, stores, compares and writes each submission.
        write_class(base / "few", teams, preset=PRESETS[0])
        write_class(base / "many", 4 * teams, preset=PRESETS[0])
        grade(base / "few", base / "first", preset=PRESETS[0])  # loads the code
        few, many = (
            grade(base / name, base / f"out-{name}", preset=PRESETS[0]).parent
            for name in ("few", "many")
        )
        costs["client"] = round((many - few) / (3 * teams), 4)
    costs["compare"] = {}
    rng = np.random.default_rng(1)
    for n in COMPARED:
        members = []
        for number in range(n):
            own = records[number % len(records)]
            other = disguised(own, own, rng, noise=20.0)
            name = str(number)
            members.append(
                Grading(submission=name, authors=(name,), fingerprints=fingerprint(other))
            )
        start = time.process_time()
        find_copies(members)
        costs["compare"][str(n)] = round(time.process_time() - start, 2)
    return costs


def comparison(costs: dict[str, Any]) -> tuple[float, float]:
    """Return seconds per submission and seconds per pair of submissions, by least squares."""
    n = np.array([float(x) for x in costs["compare"]])
    seconds = np.array(list(costs["compare"].values()))
    a, b = np.linalg.lstsq(np.column_stack([n, n**2]) / seconds[:, None], np.ones(n.size))[0]
    return float(a), float(b)


# -------------------------------------------------------------------------- simulation


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Machines that grade, and clients that send and store; times in s, rates per hour.

    Attributes
    ----------
    loss : rate at which each machine fails. Another machine repeats its work, and the failed
        machine returns after `repair` s.
    hang : share of submissions that reach the time limit and so are not graded.
    """

    machines: int
    cores: int = 16
    clients: int = 1
    client_cost: float = 0.0
    loss: float = 0.0
    repair: float = 300.0
    hang: float = 0.0
    time_limit: float = 120.0
    ahead: int = 2  # tasks in progress per core


@dataclass(frozen=True, kw_only=True)
class Night:
    """Seconds until the last result is stored, and core-seconds of work."""

    seconds: float
    busy: float
    again: float
    client_busy: float


def simulate(n: int, service: np.ndarray, *, cluster: Cluster, seed: int) -> Night:
    """Simulate a cluster that grades n submissions, event by event."""
    rng = np.random.default_rng(seed)
    length = rng.choice(service, n)
    length[rng.random(n) < cluster.hang] = cluster.time_limit
    order, events = count(), []  # (time, order, event, number of the task or machine)
    ready: deque[int] = deque()
    inbox, unsent, sent = 0, n, 0
    free = [cluster.cores] * cluster.machines
    idle = set(range(cluster.machines))
    epoch = [0] * cluster.machines
    running: list[dict[int, float]] = [{} for _ in free]
    clients, stored, now = cluster.clients, 0, 0.0
    busy = again = client_busy = 0.0
    window = cluster.ahead * cluster.cores * cluster.machines

    def at(delay: float, what: str, which: Any) -> None:
        heapq.heappush(events, (now + delay, next(order), what, which))

    if cluster.loss:
        for machine in range(cluster.machines):
            at(rng.exponential(HOUR / cluster.loss), "lost", machine)
    while stored < n:
        # Half of a client's work is sending and half is storing; storing has priority.
        while clients and (inbox or (unsent and sent - stored < window)):
            clients -= 1
            client_busy += cluster.client_cost / 2
            if inbox:
                inbox -= 1
                at(cluster.client_cost / 2, "stored", None)
            else:
                unsent -= 1
                sent += 1
                at(cluster.client_cost / 2, "sent", n - unsent - 1)
        while ready and idle:
            machine, task = next(iter(idle)), ready.popleft()
            free[machine] -= 1
            if not free[machine]:
                idle.discard(machine)
            running[machine][task] = now
            at(length[task], "graded", (machine, task, epoch[machine]))
        now, _, what, which = heapq.heappop(events)
        if what == "sent":
            clients += 1
            ready.append(which)
        elif what == "stored":
            clients += 1
            stored += 1
        elif what == "graded":
            machine, task, of = which
            if of == epoch[machine]:
                busy += now - running[machine].pop(task)
                free[machine] += 1
                idle.add(machine)
                inbox += 1
        elif what == "lost":
            again += sum(now - since for since in running[which].values())
            ready.extendleft(running[which])
            running[which].clear()
            epoch[which] += 1
            free[which] = 0
            idle.discard(which)
            at(cluster.repair, "back", which)
        else:
            free[which] = cluster.cores
            idle.add(which)
            at(rng.exponential(HOUR / cluster.loss), "lost", which)
    return Night(seconds=now, busy=busy, again=again, client_busy=client_busy)


# -------------------------------------------------------------------------------- page


def tables(costs: dict[str, Any]) -> dict[str, str]:
    """Return the tables of the page by name."""
    service = np.concatenate([np.array(v) for v in costs["seconds"].values()])
    mean, client = float(service.mean()), costs["client"] + costs["pack"]
    a, b = comparison(costs)
    rows = [
        *((f"a grade, {p}", f"{np.median(s):.2f} s, at most {max(s):.2f} s")
          for p, s in costs["seconds"].items()),
        ("a grade, a third of each", f"{mean:.2f} s"),
        ("the client, per submission", f"{1e3 * costs['client']:.0f} ms, "
            f"and {1e3 * costs['pack']:.0f} ms to pack it for a cluster"),
        ("cores that one client keeps busy", f"{mean / client:.0f}"),
        ("comparing n submissions", ", ".join(
            f"{s:.1f} s ({n})" for n, s in costs["compare"].items())),
        ("… that is", f"{1e3 * a:.1f} ms each and {1e6 * b:.0f} µs per pair"),
        ("a submission, packed", f"{costs['handed_in'] / 1e3:.0f} kB"),
        ("in the gradebook", f"{costs['kept'] / 1e3:.0f} kB"),
    ]  # fmt: skip
    measured = ["| what | costs |", "| --- | --- |", *(f"| {x} | {y} |" for x, y in rows)]

    faults = {"loss": 0.5, "hang": 0.001}
    runs = [
        (10_000, Cluster(machines=1)),
        (10_000, Cluster(machines=4)),
        (10_000, Cluster(machines=4, clients=4)),
        (1_000_000, Cluster(machines=2, clients=2)),
        (1_000_000, Cluster(machines=8)),
        (1_000_000, Cluster(machines=8, clients=10)),
    ]
    simulated = [
        "| submissions | cores | clients | arithmetic, h | simulated, h | with faults, h "
        "| core-hours paid | core-seconds done twice | clients busy |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for n, plain in runs:
        cluster = Cluster(machines=plain.machines, clients=plain.clients, client_cost=client)
        faulty = Cluster(**{**vars(cluster), **faults})
        cores = cluster.cores * cluster.machines
        clean = simulate(n, service, cluster=cluster, seed=1)
        night = simulate(n, service, cluster=faulty, seed=1)
        bound = max(n * mean / cores, n * client / cluster.clients)
        if abs(clean.seconds / bound - 1) > 0.05:
            raise RuntimeError(f"simulation {clean.seconds:.0f} s, arithmetic {bound:.0f} s")
        shares = night.client_busy / night.seconds / cluster.clients
        simulated.append(
            f"| {n:,} | {cores} | {cluster.clients} | {bound / HOUR:.2f} "
            f"| {clean.seconds / HOUR:.2f} | {night.seconds / HOUR:.2f} "
            f"| {cores * night.seconds / HOUR:,.0f} | {night.again:.0f} "
            f"| {100 * shares:.0f} % |"
        )

    compared = [
        "| submissions compared | one core | fingerprints and grades |",
        "| --- | --- | --- |",
    ]
    for n in (100, 1_000, 10_000, 100_000, 1_000_000):
        seconds = a * n + b * n * n
        span = f"{seconds / HOUR:,.1f} h" if seconds > HOUR else f"{seconds:,.0f} s"
        compared.append(f"| {n:,} | {span} | {n * costs['kept'] / 1e9:,.2f} GB |")
    needed = [
        "| submissions | core-hours | cores for a night of 8 h | clients | to store | to pay |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for n in (200, 10_000, 1_000_000):
        low, high = (significant(n * mean / HOUR * price) for price in PRICES)
        needed.append(
            f"| {n:,} | {n * mean / HOUR:,.2f} | {int(np.ceil(n * mean / NIGHT))} "
            f"| {int(np.ceil(n * client / NIGHT))} "
            f"| {n * (costs['handed_in'] + costs['kept']) / 1e9:,.2f} GB | {low} to {high} |"
        )
    texts = {"measured": measured, "needed": needed, "simulated": simulated, "compared": compared}
    return {name: "\n".join(lines) for name, lines in texts.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("measure", "page"))
    parser.add_argument("--teams", type=int, default=6)
    options = parser.parse_args()
    if options.what == "measure":
        write_file(COSTS, json.dumps(measure(teams=options.teams), indent=1) + "\n")
        return
    text = PAGE.read_text(encoding="utf-8")
    for name, table in tables(json.loads(COSTS.read_text(encoding="utf-8"))).items():
        between = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        text = between.sub(lambda found, t=table: f"{found[1]}\n{t}\n{found[2]}", text, count=1)
    write_file(PAGE, text)


if __name__ == "__main__":
    main()
