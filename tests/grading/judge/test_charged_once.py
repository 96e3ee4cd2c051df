"""One slip costs its points once, however many tables it ran through."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest

from pipeline.estimation.bode_fit import fit_bode
from pipeline.grading.mistakes.transient import early_readings
from pipeline.results import FrequencyResponse
from pipeline.setup import Setup
from pipeline.submission import ReportedStateSpace
from tests.helpers.grading_students import Student, student, typed

TURN = 2 * np.pi
Places = Sequence[str]
TABLES = ("initial", "final")
LOOP = ("model", "gains")
EVERYWHERE = (*TABLES, *LOOP)


def swap_name(name: str) -> str:
    return name.translate(str.maketrans("12", "21"))


def with_table(one: Student, table: str, numbers: Mapping[str, float | Decimal]) -> Student:
    """Return the student with other numbers in one table."""
    new = {name: typed(number) for name, number in numbers.items()}
    return one.reporting(initial=new) if table == "initial" else one.reporting(final=new)


def times(one: Student, places: Places, start: str, factor: float, *only: str) -> Student:
    """Return the student with all numbers of a kind multiplied by a factor."""
    for table in [p for p in places if p in TABLES]:
        names = [n for n in getattr(one.reported, table) if n in only or n.startswith(start)]
        numbers = {n: factor * one.value(table, n) for n in names if n in only or not only}
        one = with_table(one, table, numbers)
    return one


def swapped(one: Student, places: Places) -> Student:
    """Exchange the labels of the two carts."""
    for table in [p for p in places if p in TABLES]:
        old = getattr(one.reported, table)
        one = with_table(one, table, {n: old[swap_name(n)] for n in old})
    order, space = [2, 3, 0, 1], one.reported.state_space
    assert space is not None
    if "model" in places:
        A = tuple(tuple(space.A[i][j] for j in order) for i in order)
        one = one.reporting(state_space=ReportedStateSpace(A=A, B=tuple(space.B[i] for i in order)))
    loop = one.reported.feedback
    assert loop is not None
    if "gains" in places:
        gains = tuple(loop.gains[i] for i in order)
        one = one.reporting(feedback=loop.model_copy(update={"gains": gains}))
    return one


def miscounted(one: Student, places: Places) -> Student:
    """Count three periods where there are two."""
    one = times(one, places, "omega", 1.5, "omega_1", "omega_2")
    return times(one, places, "zeta", 1 / 1.5, "zeta_1", "zeta_2")


def peak_of_step(one: Student, places: Places) -> Student:
    """Read the largest excursion of the first step instead of its level."""
    step = next(r for r in one.analysis.records if r.kind == "step")
    assert step.u is not None
    on = np.flatnonzero(step.u)
    inside = slice(int(on[0]), int(on[-1]))
    moved = ((step.y[:, inside] - step.y[:, :1]) / step.u[on[0]]).max(axis=1).tolist()
    numbers: dict[str, float] = dict(zip(("K_1", "K_2"), moved, strict=True))
    for table in [p for p in places if p in TABLES]:
        one = with_table(one, table, numbers)
    return one


def too_early(one: Student, places: Places) -> Student:
    """Fit amplitudes of the first cycles of every dwell."""
    runs = {r.id: r for r in one.analysis.records if r.kind == "sine" and r.u is not None}
    reading = list(early_readings())[2]
    responses = []
    for cart in (1, 2):
        points = sorted(
            (p.omega, reading(runs[p.experiment], runs[p.experiment].position(cart)), p)
            for p in one.analysis.sine_points
            if p.cart == cart
        )
        magnitude = np.array([a / p.input_amplitude for _, a, p in points])
        responses.append(
            FrequencyResponse(
                cart=cart,
                omega=np.array([w for w, _, _ in points]),
                magnitude=magnitude,
                magnitude_std=0.01 * magnitude,
                phase=None,
                phase_std=None,
                source="table",
            )
        )
    assert one.analysis.fit is not None
    bench = Setup(springs=one.rubric.system.springs)
    fit = fit_bode(responses, bench=bench, near=one.analysis.fit.chain)
    return one.reporting(final={n: e.value for n, e in fit.parameters.items()})


def copied(one: Student, _: Places) -> Student:
    """Copy first estimates, typed with four digits, as final ones."""
    rough = {n: Decimal(f"{1.04 * one.value('initial', n):#.4g}") for n in one.reported.initial}
    reported = one.reported.model_copy(update={"initial": rough, "final": rough})
    return replace(one, submission=one.submission.model_copy(update={"reported": reported}))


def negative(one: Student, places: Places) -> Student:
    return times(one, places, "zeta_1", -1.0)


def model_slip(one: Student, _: Places) -> Student:
    space = one.reported.state_space
    assert space is not None
    A = [list(row) for row in space.A]
    A[1][2], A[3][0] = A[3][0], A[1][2]
    return one.reporting(state_space=space.model_copy(update={"A": tuple(map(tuple, A))}))


def reversed_gains(one: Student, _: Places) -> Student:
    loop = one.reported.feedback
    assert loop is not None
    gains = tuple(-g for g in loop.gains)
    return one.reporting(feedback=loop.model_copy(update={"gains": gains}))


def wrong_prefilter(one: Student, _: Places) -> Student:
    loop = one.reported.feedback
    assert loop is not None
    assert loop.prefilter is not None
    return one.reporting(
        feedback=loop.model_copy(update={"prefilter": typed(1 / float(loop.prefilter))})
    )


def left_out(one: Student, places: Places) -> Student:
    for table in [p for p in places if p in TABLES]:
        one = one.without(table, "zeta_1")
    return one


def spoilt(one: Student, _: Places) -> Student:
    """Let the encoder of one dwell be dead."""
    run = next(r for r in one.analysis.records if r.kind == "decay")
    y = run.y.copy()
    y[:] = y[:, :1]
    records = tuple(replace(r, y=y) if r is run else r for r in one.analysis.records)
    return replace(one, analysis=replace(one.analysis, records=records))


def no_recordings(one: Student, places: Places) -> Student:
    """Make the tables disagree, without recordings that show which one is wrong."""
    runs = tuple(e for e in one.submission.experiments if e.kind == "closed_loop")
    analysis = replace(
        one.analysis,
        records=tuple(r for r in one.analysis.records if r.kind == "closed_loop"),
        log_decrements=(),
        step_gains=(),
        sine_points=(),
        frequency_responses=(),
        fit=None,
        rows=tuple(replace(row, initial=None, final=None) for row in one.analysis.rows),
        checks=(),
    )
    submission = one.submission.model_copy(update={"experiments": runs})
    one = replace(one, submission=submission, analysis=analysis)
    return times(one, places, "K", 1.6)


def count_of(one: Student) -> float:
    return one.analysis.records[0].encoder_step(1)


Slip = Callable[[Student, Places], Student]
# Each slip, and the places that it can run through.
SLIPS: dict[str, tuple[Slip, Places]] = {
    "hz_for_rad_s": (lambda one, at: times(one, at, "omega", 1 / TURN), TABLES),
    "peak_count": (miscounted, TABLES),
    "peak_for_steady_state": (peak_of_step, TABLES),
    "peak_to_peak": (lambda one, at: times(one, at, "K", 2.0), TABLES),
    "transient_used": (too_early, ("final",)),
    "carts_swapped": (swapped, EVERYWHERE),
    "counts_for_length": (lambda one, at: times(one, at, "K", 1 / count_of(one)), TABLES),
    "log10_for_ln": (lambda one, at: times(one, at, "zeta", np.log10(np.e)), TABLES),
    "factor_of_ten": (lambda one, at: times(one, at, "K", 10.0), TABLES),
    "no_fit_done": (copied, ("final",)),
    "final_off": (lambda one, at: times(one, at, "K_1", 1.4), ("final",)),
    "initial_off": (lambda one, at: times(one, at, "omega_1", 1.23), ("initial",)),
    "initial_final_disagree": (no_recordings, ("initial",)),
    "physically_impossible": (negative, TABLES),
    "wrong_state_space": (model_slip, ("model",)),
    "wrong_gains": (reversed_gains, ("gains",)),
    "wrong_prefilter": (wrong_prefilter, ("gains",)),
    "missing": (left_out, TABLES),
    "data_problem": (spoilt, ("recordings",)),
}


def losses(honest: Student, one: Student) -> dict[str, float]:
    """Return the points that each criterion lost; criteria without a loss are left out."""
    had = {c.id: c.points for c in honest.grade().criteria}
    has = {c.id: c.points for c in one.grade().criteria}
    return {id_: had[id_] - has[id_] for id_ in had if had[id_] != has[id_]}


# A number that is missing in two tables is two missing pieces, and each of them is asked for. The
# other two run through no table, so they have no second place to be charged.
ONCE = sorted(SLIPS.keys() - {"missing", "initial_final_disagree", "data_problem"})


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("code", ONCE)
def test_a_slip_in_every_table_costs_no_more_than_in_its_dearest_criterion(code):
    """A slip in every table at once costs points, but no more than in its dearest criterion."""
    slip, places = SLIPS[code]
    honest = student(2)
    if code == "initial_final_disagree":
        honest = no_recordings(honest, ())
    alone = [losses(honest, slip(honest, (place,))) for place in places]
    everywhere = losses(honest, slip(honest, places))
    dearest = max(loss for lost in alone for loss in lost.values())
    assert 0 < sum(everywhere.values()) <= dearest


def test_one_slip_in_both_tables_is_charged_once():
    """Frequencies in Hz in both tables cost points in one criterion; the other says why not."""
    honest = student(2)
    grade = SLIPS["hz_for_rad_s"][0](honest, TABLES).grade()
    assert [flag.code for flag in grade.flags] == ["hz_for_rad_s"]
    lost = {c.id: c for c in grade.criteria if c.points < c.out_of}
    assert list(lost) == ["final-frequencies"]
    decays = next(c for c in grade.criteria if c.id == "initial-decays")
    assert decays.message.startswith("Otherwise right")
    assert lost["final-frequencies"].title in decays.message
