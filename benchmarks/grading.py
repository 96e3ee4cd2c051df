"""How often a mistake gets its right name, and an honest student none: a seeded class.

    python benchmarks/grading.py --count 260 --out grading.jsonl

Benches are random around the presets, friction is hidden in every third. Students' numbers come
from the simulator's honest claims; a mistake is made with the true chain, not with the grader's
own catalogue. One JSON line a submission; the table of codes at the end.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

from pipeline.errors import DataError
from pipeline.grading.load import load_rubric
from pipeline.grading.run import grade_submission
from pipeline.plant.chain import Chain
from pipeline.plant.effects import Term, find_effect
from pipeline.plant.simulate import simulate_linear
from pipeline.results import FrequencyResponse
from pipeline.stages.bode_fit import fit_bode
from pipeline.submission import Reported, Submission, load_submission
from pipeline.synthesis import COUNT, preset_chain, write_submission
from pipeline.synthesis.hidden import default_values

HONEST_EVERY = 3  # in so many submissions one is honest
FRICTION_EVERY = 3
LETTERS = "abcdefgh"


@dataclass(frozen=True, kw_only=True, eq=False)
class Student:
    """What a mistake may be made with."""

    submission: Submission
    chain: Chain
    rng: np.random.Generator

    @property
    def n(self) -> int:
        """Number of carts."""
        return self.chain.n

    def numbers(self, start: str) -> list[str]:
        """Return the names of the carts' own parameters that begin so: K_1 …, or K."""
        if self.n == 1:
            return ["omega_n" if start == "omega" else start]
        return [f"{start}_{i}" for i in range(1, self.n + 1)]

    def reported(self) -> Reported:
        """What they report so far."""
        assert self.submission.reported is not None
        return self.submission.reported


def typed(value: float, digits: int = 3) -> Decimal:
    return Decimal(f"{value:#.{digits}g}".removesuffix("."))


def change(student: Student, **tables: dict[str, float]) -> Submission:
    """Return the submission with numbers of the initial or final table replaced."""
    reported = student.reported()
    update = {
        label: {**getattr(reported, label), **{k: typed(v) for k, v in numbers.items()}}
        for label, numbers in tables.items()
    }
    return student.submission.model_copy(update={"reported": reported.model_copy(update=update)})


def value(student: Student, table: str, name: str) -> float:
    return float(getattr(student.reported(), table)[name])


def some_tables(student: Student) -> list[str]:
    return [["initial"], ["final"], ["initial", "final"]][int(student.rng.integers(3))]


def scaled(student: Student, names: list[str], factor: float, tables: list[str]) -> Submission:
    return change(
        student,
        **{t: {name: factor * value(student, t, name) for name in names} for t in tables},
    )


# ------------------------------------------------------------------------ the mistakes


def hz(student: Student) -> Submission:
    names = [n for n in student.reported().final if n.startswith("omega")]
    if student.rng.random() < 0.3:
        names = [str(student.rng.choice(names))]
    return scaled(student, names, 1 / (2 * np.pi), some_tables(student))


def peak_count(student: Student) -> Submission:
    k = int(student.rng.integers(1, 7))
    ratio = (k + 1) / k if student.rng.random() < 0.7 else k / (k + 1)
    numbers = {}
    for omega in student.numbers("omega"):
        zeta = omega.replace("omega", "zeta").replace("zeta_n", "zeta")
        numbers[omega] = value(student, "initial", omega) * ratio
        numbers[zeta] = value(student, "initial", zeta) / ratio
    return change(student, initial=numbers)


def step_peaks(student: Student) -> list[float]:
    """Return the furthest each cart goes after the first edge of the first step, per volt."""
    run = next(e for e in student.submission.experiments if e.kind == "step")
    table = np.genfromtxt(student.submission.folder / run.file, delimiter=",", names=True)
    u, on = table["input"], np.flatnonzero(table["input"])
    inside = slice(int(on[0]), int(on[-1]))
    moved = [table[f"x{i}"] - table[f"x{i}"][0] for i in range(1, student.n + 1)]
    return [float((x[inside] / u[on[0]]).max()) for x in moved]


def peak_for_steady_state(student: Student) -> Submission:
    peaks = dict(zip(student.numbers("K"), step_peaks(student), strict=True))
    return change(student, initial=peaks)


def peak_to_peak(student: Student) -> Submission:
    return scaled(student, student.numbers("K"), 2.0, some_tables(student))


def counts_for_length(student: Student) -> Submission:
    return scaled(student, student.numbers("K"), 1 / COUNT, some_tables(student))


def log10_for_ln(student: Student) -> Submission:
    return scaled(student, student.numbers("zeta"), np.log10(np.e), ["initial"])


def carts_swapped(student: Student) -> Submission:
    order = list(range(1, student.n + 1))
    i, j = student.rng.choice(order, 2, replace=False)
    groups = [["K"], ["omega", "zeta"], ["K", "omega", "zeta"]][int(student.rng.integers(3))]
    omegas = [value(student, "final", f"omega_{c}") for c in (i, j)]
    if abs(np.log(omegas[0] / omegas[1])) < 0.15:  # nobody can see them swapped
        groups = ["K"]
    tables = some_tables(student)
    numbers = {}
    for t in tables:
        numbers[t] = {}
        for g in groups:
            numbers[t][f"{g}_{i}"] = value(student, t, f"{g}_{j}")
            numbers[t][f"{g}_{j}"] = value(student, t, f"{g}_{i}")
    return change(student, **numbers)


def no_fit_done(student: Student) -> Submission:
    reported = student.reported()
    return student.submission.model_copy(
        update={"reported": reported.model_copy(update={"final": dict(reported.initial)})}
    )


def _one_off(student: Student, table: str) -> Submission:
    known = [n for n in student.reported().final if not n.startswith("zeta")]
    if table == "initial":
        known = [*student.numbers("K"), *student.numbers("omega")]
    while True:
        name = str(student.rng.choice(known))
        factor = student.rng.uniform(1.15, 1.45) ** float(student.rng.choice([-1, 1]))
        numbers = {**getattr(student.reported(), table)}
        numbers[name] = typed(factor * float(numbers[name]))
        gains = [numbers[other] for other in student.numbers("K")]
        if gains == sorted(gains, reverse=True):  # else it is an impossible one
            return change(student, **{table: {name: float(numbers[name])}})


def final_off(student: Student) -> Submission:
    return _one_off(student, "final")


def initial_off(student: Student) -> Submission:
    return _one_off(student, "initial")


def physically_impossible(student: Student) -> Submission:
    if student.n == 1 or student.rng.random() < 0.5:
        names = [n for n in student.reported().final if not n.startswith("omega")]
        return scaled(student, [str(student.rng.choice(names))], -1.0, ["final"])
    return change(student, final={"K_2": 1.2 * value(student, "final", "K_1")})


def wrong_state_space(student: Student) -> Submission:
    reported = student.reported()
    assert reported.state_space is not None
    A = [list(row) for row in reported.state_space.A]
    n, kind = student.n, int(student.rng.integers(4))
    if kind == 0:
        A[1][0] = -A[1][0]
    elif kind == 1 and n > 1:
        A[1][2], A[3][0] = A[3][0], A[1][2]
        if abs(float(A[1][2] / A[3][0]) - 1) < 0.3:
            A[1][2] = Decimal(0)
    elif kind == 2 and n > 1:
        order = [*range(0, 2 * n, 2), *range(1, 2 * n, 2)]
        A = [[A[i][j] for j in order] for i in order]
    else:
        for i in range(n):
            A[2 * i + 1][2 * i] = typed(-np.sqrt(abs(float(A[2 * i + 1][2 * i]))), 4)
    space = reported.state_space.model_copy(update={"A": tuple(map(tuple, A))})
    return student.submission.model_copy(
        update={"reported": reported.model_copy(update={"state_space": space})}
    )


def _feedback(student: Student, **update) -> Submission:
    reported = student.reported()
    assert reported.feedback is not None
    feedback = reported.feedback.model_copy(update=update)
    return student.submission.model_copy(
        update={"reported": reported.model_copy(update={"feedback": feedback})}
    )


def wrong_gains(student: Student) -> Submission:
    feedback = student.reported().feedback
    assert feedback is not None
    gains = [float(g) for g in feedback.gains]
    kind = int(student.rng.integers(3))
    if kind == 0:
        gains = [-g for g in gains]
    elif kind == 1 and student.n > 1:
        gains = [*gains[0::2], *gains[1::2]]
    else:
        gains = [2.5 * g for g in gains]
    submission = _feedback(student, gains=tuple(typed(g, 4) for g in gains))
    if student.rng.random() < 0.5:  # … and did not say what ran
        runs = tuple(e.model_copy(update={"controller": None}) for e in submission.experiments)
        submission = submission.model_copy(update={"experiments": runs})
    return submission


def wrong_prefilter(student: Student) -> Submission:
    feedback = student.reported().feedback
    assert feedback is not None
    assert feedback.prefilter is not None
    right = float(feedback.prefilter)
    wrong = [1 / right, 1.0, right * 1.3, right * 0.7][int(student.rng.integers(4))]
    return _feedback(student, prefilter=typed(wrong, 4))


def missing(student: Student) -> Submission:
    reported = student.reported()
    kind = int(student.rng.integers(3))
    if kind == 0:
        final = dict(reported.final)
        del final[str(student.rng.choice(list(final)))]
        update = {"reported": reported.model_copy(update={"final": final})}
    elif kind == 1:
        update = {"reported": reported.model_copy(update={"state_space": None})}
    else:
        runs = tuple(e for e in student.submission.experiments if e.kind != "closed_loop")
        update = {"experiments": runs}
    return student.submission.model_copy(update=update)


def transient_used(student: Student) -> Submission:
    """Amplitudes read off the first cycles of every dwell, and a fit to them."""
    for cycles in student.rng.permutation([2.0, 3.0]):
        try:
            fit = fit_bode(
                _early(student, float(cycles)),
                n=student.n,
                springs=[bool(k > 0) for k in student.chain.k],
                initial=student.chain.parameters(),
            )
        except DataError:  # nothing fits such amplitudes; they would try others
            continue
        return change(student, final={name: e.value for name, e in fit.parameters.items()})
    raise AssertionError("no fit to early amplitudes")


def _early(student: Student, cycles: float) -> list[FrequencyResponse]:
    """Return what half the swing of the first cycles gives."""
    dwells = [e.frequency for e in student.submission.experiments if e.kind == "sine"]
    frequencies = np.array(dwells, dtype=float)
    chain, rows = student.chain, []
    for hertz in frequencies:
        t = np.linspace(0, cycles / hertz, 800)
        y = simulate_linear(chain, t, np.sin(2 * np.pi * hertz * t))
        rows.append(np.ptp(y, axis=1) / 2)
    magnitude = np.array(rows).T * (1 + 0.005 * student.rng.standard_normal((chain.n, len(rows))))
    return [
        FrequencyResponse(
            cart=cart,
            omega=2 * np.pi * frequencies,
            magnitude=magnitude[cart - 1],
            magnitude_std=0.01 * magnitude[cart - 1],
            phase=None,
            phase_std=None,
            source="table",
        )
        for cart in range(1, chain.n + 1)
    ]


def data_problem(student: Student) -> Submission:
    """Spoil one file: an encoder that sticks, a copy in its place, the end cut off."""
    runs = [e for e in student.submission.experiments if e.kind in ("decay", "step", "sine")]
    run = runs[int(student.rng.integers(len(runs)))]
    path = student.submission.folder / run.file
    lines = path.read_text(encoding="utf-8").splitlines()
    kind = int(student.rng.integers(3))
    if kind == 0:  # it sticks while it moves
        cart = run.carts[0]
        column = lines[0].split(",").index(f"x{cart}")
        rows = [line.split(",") for line in lines[1:]]
        x = np.array([float(row[column]) for row in rows])
        start = int(np.argmax(np.abs(np.diff(x))))
        for row in rows[start : start + 60]:
            row[column] = rows[start][column]
        lines = [lines[0], *(",".join(row) for row in rows)]
    elif kind == 1:
        others = [e for e in runs if e.id != run.id]
        other = others[int(student.rng.integers(len(others)))]
        lines = (student.submission.folder / other.file).read_text(encoding="utf-8").splitlines()
    else:
        lines = lines[: len(lines) // 2]
        lines[-1] = lines[-1][: len(lines[-1]) // 2].rstrip(",")
        lines[-1] = lines[-1].split(",")[0]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    return student.submission


SINGLE: dict[str, Callable[[Student], Submission]] = {
    "hz_for_rad_s": hz,
    "peak_count": peak_count,
    "peak_for_steady_state": peak_for_steady_state,
    "peak_to_peak": peak_to_peak,
    "transient_used": transient_used,
    "carts_swapped": carts_swapped,
    "counts_for_length": counts_for_length,
    "log10_for_ln": log10_for_ln,
    "no_fit_done": no_fit_done,
    "final_off": final_off,
    "initial_off": initial_off,
    "initial_final_disagree": lambda s: disagree(s),
    "physically_impossible": physically_impossible,
    "wrong_state_space": wrong_state_space,
    "wrong_gains": wrong_gains,
    "wrong_prefilter": wrong_prefilter,
    "missing": missing,
    "data_problem": data_problem,
}
DOUBLE = (
    ("hz_for_rad_s", "carts_swapped"),
    ("counts_for_length", "carts_swapped"),
    ("peak_count", "log10_for_ln"),
    ("hz_for_rad_s", "log10_for_ln"),
    ("counts_for_length", "peak_to_peak"),
    ("wrong_state_space", "wrong_prefilter"),
    ("hz_for_rad_s", "peak_to_peak"),
)


def disagree(student: Student) -> Submission:
    """Without its decays nothing but the students' own tables tells that one is wrong."""
    runs = tuple(e for e in student.submission.experiments if e.kind == "closed_loop")
    name = student.numbers("K")[0]
    submission = scaled(student, [name], 1.6, ["initial"])
    return submission.model_copy(update={"experiments": runs})


# --------------------------------------------------------------------------- the class


def make_student(folder: Path, *, index: int, friction: bool) -> Student:
    rng = np.random.default_rng([77, index])
    n = 1 + index % 3
    preset = preset_chain(f"throne-{n}dof")
    chain = Chain(
        m=preset.m * rng.uniform(0.8, 1.25, n),
        c=preset.c * rng.uniform(0.7, 1.4, n),
        k=preset.k * rng.uniform(0.8, 1.25, n + 1),
    )
    effects = []
    if friction:
        effect = find_effect(str(rng.choice(["coulomb_friction", "stiction"])))
        cart = int(rng.integers(1, n + 1))
        values = default_values(effect, chain, place=cart, travel=1.0)
        size = rng.uniform(0.3, 1.2)
        values = {k: v * (size if k.endswith("force") else 1.0) for k, v in values.items()}
        effects = [Term(effect=effect, place=cart, values=tuple(values[x] for x in effect.names))]
    write_submission(
        folder, chain=chain, seed=index, effects=effects, compact=index % 2 == 0, reported=True
    )
    return Student(submission=load_submission(folder), chain=chain, rng=rng)


def plan(index: int) -> tuple[str, ...]:
    """Return the mistakes of a submission."""
    if index % HONEST_EVERY == 0:
        return ()
    number = index - index // HONEST_EVERY - 1
    kinds: list[tuple[str, ...]] = [(code,) for code in SINGLE]
    kinds += list(DOUBLE)
    return kinds[number % len(kinds)]


def run(index: int) -> dict:
    codes = plan(index)
    number = index // HONEST_EVERY if not codes else index
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / f"team-{index}"
        carts = 1 + (index + index // 3) % 3
        swaps = "carts_swapped" in codes
        if swaps and carts == 1:
            carts = 2
        student = make_student(
            folder, index=3 * index + carts - 1, friction=number % FRICTION_EVERY == 1
        )
        if "transient_used" in codes:
            write_submission(folder, chain=student.chain, seed=index, reported=True)
            student = Student(
                submission=load_submission(folder), chain=student.chain, rng=student.rng
            )
        for code in codes:
            student = Student(
                submission=SINGLE[code](student), chain=student.chain, rng=student.rng
            )
        rubric = load_rubric(Path(f"throne-{student.n}dof"))
        start = time.process_time()
        grade = grade_submission(student.submission, rubric=rubric, name=f"team-{index}").grade
        seconds = time.process_time() - start
    return {
        "index": index,
        "carts": student.n,
        "friction": number % FRICTION_EVERY == 1,
        "codes": codes,
        "flags": {flag.code: [*flag.parameters] for flag in grade.flags},
        "messages": [flag.message for flag in grade.flags],
        "points": grade.points,
        "seconds": seconds,
        "status": grade.status,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=260)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--only", help="submissions with this code only; 'honest' for none")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for index in range(options.start, options.start + options.count):
        codes = plan(index)
        if options.only and options.only not in (codes or ("honest",)):
            continue
        row = run(index)
        rows.append(row)
        right = set(codes) <= set(row["flags"]) if codes else not row["flags"]
        extra = set(row["flags"]) - set(codes)
        if not right or extra:
            print(index, row["carts"], "friction" * row["friction"], codes, "->", row["flags"])
            for message in row["messages"]:
                print("      ", message)
        sys.stdout.flush()
    if options.out:
        options.out.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    report(rows)


def report(rows: list[dict]) -> None:
    wrong = [r for r in rows if r["codes"]]
    honest = [r for r in rows if not r["codes"]]
    named = [set(r["codes"]) <= set(r["flags"]) for r in wrong]
    only = [set(r["codes"]) == set(r["flags"]) for r in wrong]
    flagged = [bool(r["flags"]) for r in wrong]
    accused = [bool(r["flags"]) for r in honest]
    for label, values in (
        ("right code", named),
        ("right code and no other", only),
        ("flagged at all", flagged),
        ("honest with any flag", accused),
    ):
        if values:
            print(f"{label}: {sum(values)}/{len(values)} = {100 * np.mean(values):.1f} %")
    seconds = np.array([r["seconds"] for r in rows])
    print(f"CPU s a submission: median {np.median(seconds):.3f}, mean {seconds.mean():.3f}")
    misses = Counter(c for r in wrong for c in r["codes"] if c not in r["flags"])
    print("missed:", dict(misses))
    points = [r["points"] for r in honest]
    if points:
        print(f"honest points: {min(points):.2f} to {max(points):.2f}, mean {np.mean(points):.2f}")


if __name__ == "__main__":
    main()
