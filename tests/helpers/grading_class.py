"""A class of honest teams on benches of every kind, with numbers found by textbook methods.

Each number is what a student reads by the textbook, if that is near the true value. Otherwise a
more careful student's number is used.
"""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.state_feedback import design_feedback
from pipeline.grading.judge.run import under_rubric, with_all_springs
from pipeline.grading.mistakes.state_model import own_chain
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.names import read_name
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import Chain
from pipeline.plant.effect import EffectTerm
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.hidden import preset_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import (
    Design,
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    Submission,
    load_submission,
)
from pipeline.workflow import analyse
from tests.helpers.grading_students import Student
from tests.helpers.textbook_student import by_eye, final_table, initial_table

ZETAS = (0.003, 0.15)
DWELLS = (6, 22)
COUNTS = (5.0, 500.0)  # encoder counts per centimetre
DIGITS = (2, 4)
FRICTION = 0.02  # largest dry friction, as a share of the small step's force
LEAST_COUNTS = 25.0  # least travel of the carts in encoder counts

# The largest relative errors of honest numbers: for gains and frequencies, then for dampings.
HONEST_FIRST, HONEST_FIRST_DAMPING = 0.06, 0.4
HONEST_BY_EYE = 0.2
HONEST_FINAL, HONEST_FINAL_DAMPING = 0.03, 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """The bench of a team and its settings.

    Attributes
    ----------
    count, travel : encoder step, and how far the carts should move, both in cm.
    friction : dry friction of each cart, as a share of the force of the small step.
    digits : number of digits that the team types.
    """

    chain: Chain
    count: float
    travel: float
    dwells: int
    digits: int
    friction: float

    @property
    def springs(self) -> tuple[bool, ...]:
        """Return which springs the bench has."""
        return tuple(bool(k > 0) for k in self.chain.k)

    def effects(self) -> list[EffectTerm]:
        """Return the dry friction as effects."""
        if not self.friction:
            return []
        effect = find_effect("coulomb_friction")
        step = 0.5 * self.travel / float(np.max(self.chain.static_gains()))
        force = (self.friction * step,)
        return [
            EffectTerm(effect=effect, place=i, values=force) for i in range(1, self.chain.n + 1)
        ]


def make_bench(rng: np.random.Generator, *, carts: int) -> Bench:
    """Draw a bench at random; about half of the benches have dry friction."""
    preset = preset_bench(f"throne-{carts}dof").chain
    m = preset.m * rng.uniform(0.7, 1.4, carts)
    k = preset.k * rng.uniform(0.7, 1.4, carts + 1)
    if carts > 1 and rng.random() < 0.5:
        k[0] = k[1] * rng.uniform(0.2, 1.0)
        if rng.random() < 0.3:
            k[-1] = 0.0
    zeta = float(np.exp(rng.uniform(*np.log(ZETAS)))) * rng.uniform(0.8, 1.25, carts)
    zeta = np.clip(zeta, *ZETAS)
    count = 1 / float(np.exp(rng.uniform(*np.log(COUNTS))))
    return Bench(
        chain=Chain(m=m, c=2 * zeta * np.sqrt(m * (k[:-1] + k[1:])), k=k),
        count=count,
        travel=max(1.0, LEAST_COUNTS * count),
        dwells=int(rng.integers(DWELLS[0], DWELLS[1] + 1)),
        digits=int(rng.integers(DIGITS[0], DIGITS[1] + 1)),
        friction=FRICTION * float(rng.random()) if rng.random() < 0.5 else 0.0,
    )


def rubric_of(bench: Bench, rubric: Rubric | None = None) -> Rubric:
    """Return the rubric of a class that uses this bench, from one for as many carts.

    By default, it is the shipped one. The task of the controller is the submission's own.
    """
    rubric = rubric or load_rubric(Path(f"throne-{bench.chain.n}dof"))
    runs = tuple(
        run.model_copy(update={"at_least": min(run.at_least, DWELLS[0])})
        for run in rubric.required.experiments
    )
    return rubric.model_copy(
        update={
            "system": rubric.system.model_copy(update={"springs": bench.springs}),
            "required": rubric.required.model_copy(update={"experiments": runs}),
            "design": None,
        }
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Team(Student):
    """An honest team; only the test knows `bench`."""

    bench: Bench
    rng: np.random.Generator


def make_team(seed: int, *, folder: Path | None = None, **bench: Any) -> Team:
    """Return an honest team with bench, recordings, analysis and report.

    Parameters
    ----------
    folder : where the team's files stay; by default they are removed.
    bench : fields of `Bench` with given values; the others are drawn at random.
    """
    rng = np.random.default_rng([2005, seed])
    drawn = replace(make_bench(rng, carts=1 + seed % 3), **bench)
    if folder is None:
        with tempfile.TemporaryDirectory() as scratch:
            return _team(drawn, rng, seed=seed, folder=Path(scratch))
    return _team(drawn, rng, seed=seed, folder=folder)


def with_spoilt_data(seed: int) -> Team:
    """Return the team of a seed, with one file spoilt before the analysis."""
    rng = np.random.default_rng([2005, seed])
    bench = make_bench(rng, carts=1 + seed % 3)
    with tempfile.TemporaryDirectory() as folder:
        return _team(bench, rng, seed=seed, folder=Path(folder), spoil=spoil_data)


def with_wrong_rubric(seed: int) -> Team | None:
    """Return the team of a seed with a rubric that wrongly lacks the spring to the near wall.

    If the team has no such spring, return None.
    """
    rng = np.random.default_rng([2005, seed])
    bench = make_bench(rng, carts=1 + seed % 3)
    if bench.chain.n == 1 or not bench.springs[0]:
        return None
    rubric = rubric_of(bench)
    system = rubric.system.model_copy(update={"springs": (False, *bench.springs[1:])})
    rubric = rubric.model_copy(update={"system": system})
    with tempfile.TemporaryDirectory() as folder:
        return _team(bench, rng, seed=seed, folder=Path(folder), rubric=rubric)


def _team(
    bench: Bench,
    rng: np.random.Generator,
    *,
    seed: int,
    folder: Path,
    rubric: Rubric | None = None,
    spoil: Callable[[Submission, np.random.Generator], None] = lambda *_: None,
) -> Team:
    write_submission(
        folder,
        SimulatedBench(
            chain=bench.chain,
            effects=tuple(bench.effects()),
            count=bench.count,
            travel=bench.travel,
        ),
        seed=seed,
        compact=seed % 2 == 0,
        reported=True,
    )
    rubric = rubric or rubric_of(bench)
    submission = _fewer_dwells(load_submission(folder), bench.dwells)
    spoil(submission, rng)
    submission, _ = under_rubric(submission, rubric)
    team = Team(
        submission=submission,
        analysis=with_all_springs(submission, analyse(submission, design=False))[0],
        rubric=rubric,
        bench=bench,
        rng=rng,
    )
    return report(team)


def spoil_data(submission: Submission, rng: np.random.Generator) -> None:
    """Spoil one file: its encoder sticks, or it becomes a copy of another."""
    runs = [e for e in submission.experiments if e.kind in ("decay", "step", "sine")]
    run = runs[int(rng.integers(len(runs)))]
    path = submission.folder / run.file
    lines = path.read_text(encoding="utf-8").splitlines()
    if rng.integers(2):  # the encoder sticks while the cart moves
        column = lines[0].split(",").index(f"x{run.carts[0] if run.carts else 1}")
        rows = [line.split(",") for line in lines[1:]]
        x = np.array([float(row[column]) for row in rows])
        start = int(np.argmax(np.abs(np.diff(x))))
        for row in rows[start : start + 60]:
            row[column] = rows[start][column]
        lines = [lines[0], *(",".join(row) for row in rows)]
    else:
        others = [e for e in runs if e.id != run.id]
        other = others[int(rng.integers(len(others)))]
        lines = (submission.folder / other.file).read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _fewer_dwells(submission: Submission, count: int) -> Submission:
    """Return the submission with only this many of its dwells, evenly chosen."""
    sines = [e.id for e in submission.experiments if e.kind == "sine"]
    chosen = {sines[i] for i in np.linspace(0, len(sines) - 1, count).round().astype(int)}
    kept = tuple(e for e in submission.experiments if e.kind != "sine" or e.id in chosen)
    return submission.model_copy(update={"experiments": kept})


# ---------------------------------------------------------------- reported numbers


def report(team: Team) -> Team:
    """Return the team with its report, computed from its own recordings."""
    n, records, rng = team.bench.chain.n, team.analysis.records, team.rng
    truth, digits = team.bench.chain.parameters(), team.bench.digits
    read = initial_table(records, n)
    try:
        read |= by_eye(records, n) if n > 1 else {}
    except ValueError:  # no dwell moves every cart far enough
        pass
    first = {x: _first(team, x, read.get(x, np.nan), right) for x, right in truth.items()}
    believed = {x: float(v) for x, v in team.reported.final.items()}
    spread = {x: 0.1 if read_name(x).is_damping else 0.01 for x in truth}
    one_by_one = {x: v * (1 + spread[x] * _error(rng)) for x, v in truth.items()}
    final = [_fitted(team, first) or believed, believed, one_by_one][int(rng.integers(3))]
    table = {x: written(v, digits) for x, v in final.items()}
    space, feedback = team.reported.state_space, team.reported.feedback
    if final is not believed:
        # Compute model and controller from the exact numbers or from the typed ones.
        values = final if rng.random() < 0.5 else {x: float(v) for x, v in table.items()}
        own = own_chain(values, n=n)
        if own is not None and is_real(own):
            rows = own.state_space()[:2] if rng.random() < 0.5 else from_statics(values, n)
            space = state_space(*rows, digits=digits)
            feedback = designed(team.submission, own) or feedback
    reported = Reported(
        initial={x: written(v, digits) for x, v in first.items()},
        final=table,
        state_space=space,
        feedback=feedback,
    )
    submission = team.submission.model_copy(update={"reported": reported})
    if feedback is not team.reported.feedback:
        runs = tuple(e.model_copy(update={"controller": None}) for e in submission.experiments)
        submission = submission.model_copy(update={"experiments": runs})
    return replace(team, submission=submission)


def _error(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -2, 2))


def from_statics(p: Mapping[str, float], n: int) -> tuple[Array, Array]:
    """Return A and B with couplings computed from rest positions."""
    if n == 1:
        return np.array([[0, 1], [-(p["omega_n"] ** 2), -2 * p["zeta"] * p["omega_n"]]]), np.array(
            [[0], [p["K"] * p["omega_n"] ** 2]]
        )
    K = [p[f"K_{i}"] for i in range(1, n + 1)]
    w = [p[f"omega_{i}"] ** 2 for i in range(1, n + 1)]
    d = float(np.prod([p[f"omega_{x}"] ** 2 for x in "abc"[:n]]))
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 1))
    A[0::2, 1::2] = np.eye(n)
    for i in range(n):
        A[2 * i + 1, 2 * i] = -w[i]
        A[2 * i + 1, 2 * i + 1] = -2 * p[f"zeta_{i + 1}"] * p[f"omega_{i + 1}"]
    back = w[-1] * K[-1] / K[-2]  # k_n / m_n: the last cart rests where two springs balance
    A[-1, -4] = back
    if n == 2:
        first = (w[0] * w[1] - d) / back
    else:
        nulls = (p["omega_x"] * p["omega_y"]) ** 2
        A[3, 4] = (w[1] * w[2] - nulls) / back
        A[3, 0] = (w[1] * K[1] - A[3, 4] * K[2]) / K[0]
        first = (w[0] * nulls - d) / w[2] / A[3, 0]
    A[1, 2] = first
    B[1, 0] = w[0] * K[0] - first * K[1]
    return A, B


def is_real(chain: Chain) -> bool:
    """Return whether real carts could form this chain."""
    return bool(np.all(chain.c > 0) and np.all(np.linalg.eigvalsh(chain.stiffness) > 0))


def _first(team: Team, name: str, read: float, right: float) -> float:
    """Return the value that a student reads, or a more careful one if it is far from the truth."""
    guessed = team.bench.chain.n > 1 and read_name(name).is_damping and not name[-1].isdigit()
    if guessed:
        return 0.1
    by_hand = team.bench.chain.n > 1 and name.startswith("omega") and not name[-1].isdigit()
    limit = HONEST_BY_EYE if by_hand else HONEST_FIRST
    limit = HONEST_FIRST_DAMPING if read_name(name).is_damping else limit
    if abs(np.log(max(read, 1e-300) / right)) <= np.log1p(limit):
        return read
    return right * float(np.exp(0.3 * limit * _error(team.rng)))


def _fitted(team: Team, first: Mapping[str, float]) -> dict[str, float] | None:
    """Return the final table of a fit to magnitudes in dB, or None if it is far from the truth."""
    n = team.bench.chain.n
    try:
        found = final_table(team.analysis.records, n, dict(first))
    except (ValueError, FloatingPointError):  # too few points for a fit
        return None
    truth = team.bench.chain.parameters()
    near = all(
        x in found
        and abs(np.log(found[x] / right))
        <= np.log1p(HONEST_FINAL_DAMPING if read_name(x).is_damping else HONEST_FINAL)
        for x, right in truth.items()
    )
    return {x: found[x] for x in truth} if near else None


def written(value: float, digits: int) -> Decimal:
    """Return a number typed with this many digits."""
    return Decimal(f"{value:#.{digits}g}".removesuffix("."))


def state_space(A: Array, B: Array, *, digits: int) -> ReportedStateSpace:
    """Return A and B as typed."""

    def entry(value: float) -> Decimal:
        return Decimal(f"{value:g}") if value in (0.0, 1.0) else written(value, digits)

    return ReportedStateSpace(
        A=tuple(tuple(map(entry, row)) for row in A.tolist()),
        B=tuple(map(entry, B[:, 0].tolist())),
    )


def designed(submission: Submission, chain: Chain) -> ReportedFeedback | None:
    """Return a controller designed for a team's own carts, as typed."""
    task = submission.design or Design(cart=chain.n)
    try:
        design = design_feedback(chain, task)
    except DataError:
        return None
    if design.settling_time is None:
        return None
    return ReportedFeedback(
        gains=tuple(written(g, 4) for g in design.gains.tolist()),
        prefilter=written(design.prefilter, 4),
        overshoot_percent=Decimal(f"{design.overshoot_percent:.1f}"),
        settling_time=Decimal(f"{design.settling_time:.2f}"),
    )
