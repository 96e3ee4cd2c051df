"""Each slip gets its own flag and no other, and costs its points once; honest students get none."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from decimal import Decimal
from functools import reduce
from typing import Any

import numpy as np
import pytest

from pipeline.estimation.bode_fit import fit_bode
from pipeline.grading.grade import Flag
from pipeline.grading.mistakes.catalogue import early_readings
from pipeline.results import FrequencyResponse
from pipeline.setup import Setup
from pipeline.submission import Reported, ReportedFeedback, ReportedStateSpace
from tests.helpers.grading_students import Student, criterion, student, typed
from tests.helpers.textbook_student import by_eye, final_table, initial_table

TURN = 2 * np.pi
COUNT = 0.00227  # cm per count of the simulated encoder
FRICTION = ("coulomb_friction",)
FROM_TABLES = {"initial", "final", "comparison", "laws", "state"}  # ids begin with these
CARTS = (1, 2, 3)
INITIAL, FINAL = TABLES = ("initial", "final")
Slip = Callable[[Student, str], Student]  # changes one table, the state model or the gains


def flags(one: Student) -> list[str]:
    return [flag.code for flag in one.grade().flags]


def only_flag(one: Student) -> Flag:
    (flag,) = one.grade().flags
    return flag


def own(symbol: str, n: int) -> list[str]:
    """Return the names of the carts' own gains, frequencies or dampings."""
    if n == 1:
        return ["omega_n" if symbol == "omega" else symbol]
    return [f"{symbol}_{i}" for i in range(1, n + 1)]


def space_of(one: Student) -> ReportedStateSpace:
    assert one.reported.state_space is not None
    return one.reported.state_space


def loop_of(one: Student) -> ReportedFeedback:
    assert one.reported.feedback is not None
    return one.reported.feedback


def with_gains(one: Student, *gains: float | Decimal) -> Student:
    new = tuple(typed(gain) for gain in gains)
    return one.reporting(feedback=loop_of(one).model_copy(update={"gains": new}))


def with_rows(one: Student, A: list[list[Decimal]]) -> Student:
    return one.reporting(state_space=space_of(one).model_copy(update={"A": tuple(map(tuple, A))}))


def reporting(one: Student, reported: Reported) -> Student:
    return replace(one, submission=one.submission.model_copy(update={"reported": reported}))


def with_table(one: Student, table: str, numbers: dict) -> Student:
    return one.reporting(initial=numbers) if table == INITIAL else one.reporting(final=numbers)


def scaled(factor: float, *starts: str) -> Slip:
    """Multiply all numbers whose names begin so."""

    def scale(one: Student, table: str) -> Student:
        names = [n for n in getattr(one.reported, table) if n.startswith(starts)]
        return with_table(one, table, {n: factor * one.value(table, n) for n in names})

    return scale


def carts_of(one: Student, symbol: str) -> tuple[str, ...]:
    return tuple(own(symbol, one.rubric.system.carts))


def miscounted(k: int) -> Slip:
    """Count k + 1 periods instead of k: ω is (k + 1)/k times too large, ζ too small by as much."""

    def count(one: Student, table: str) -> Student:
        one = scaled((k + 1) / k, *carts_of(one, "omega"))(one, table)
        return scaled(k / (k + 1), *carts_of(one, "zeta"))(one, table)

    return count


def wrong_logarithm(one: Student, table: str) -> Student:
    return scaled(np.log10(np.e), *carts_of(one, "zeta"))(one, table)


def swapped(one: Student, place: str) -> Student:
    """Exchange the labels of the first and the last cart."""
    n = one.rubric.system.carts
    if place in TABLES:
        pairs = [(f"{symbol}_1", f"{symbol}_{n}") for symbol in ("K", "omega", "zeta")]
        table = getattr(one.reported, place)
        other = {name: table[of] for pair in pairs for name, of in (pair, pair[::-1])}
        return with_table(one, place, other)
    order = [2, 3, 0, 1]
    if place == "gains":
        return with_gains(one, *(loop_of(one).gains[i] for i in order))
    space = space_of(one)
    A = tuple(tuple(space.A[i][j] for j in order) for i in order)
    return one.reporting(state_space=ReportedStateSpace(A=A, B=tuple(space.B[i] for i in order)))


def peak_of_step(one: Student, table: str) -> Student:
    """Read the largest excursion of the first step instead of its level."""
    step = next(r for r in one.analysis.records if r.kind == "step")
    assert step.u is not None
    on = np.flatnonzero(step.u)
    peaks = ((step.y[:, on] - step.y[:, :1]) / step.u[on]).max(axis=1).tolist()
    return with_table(one, table, dict(zip(carts_of(one, "K"), peaks, strict=True)))


def too_early(one: Student, _: str) -> Student:
    """Fit amplitudes of the first cycles of every dwell."""
    runs = {r.id: r for r in one.analysis.records if r.kind == "sine" and r.u is not None}
    reading = list(early_readings())[2]
    responses = []
    for cart in (1, 2):
        points = [
            (
                p.omega,
                reading(runs[p.experiment], runs[p.experiment].position(cart)) / p.input_amplitude,
            )
            for p in one.analysis.sine_points
            if p.cart == cart
        ]
        omega, magnitude = np.array(sorted(points)).T
        response = FrequencyResponse(
            cart=cart, omega=omega, magnitude=magnitude, magnitude_std=0.01 * magnitude,
            phase=None, phase_std=None, source="table",
        )  # fmt: skip
        responses.append(response)
    assert one.analysis.fit is not None
    bench = Setup(springs=one.rubric.system.springs)
    fit = fit_bode(responses, bench=bench, near=one.analysis.fit.chain)
    return one.reporting(final={n: e.value for n, e in fit.parameters.items()})


def copied(one: Student, _: str) -> Student:
    """Copy first estimates, typed with four digits, as final ones."""
    rough = {n: Decimal(f"{1.04 * one.value(INITIAL, n):#.4g}") for n in one.reported.initial}
    return one.reporting(initial=rough, final=rough)


def exchanged_couplings(one: Student, _: str) -> Student:
    A = [list(row) for row in space_of(one).A]
    A[1][2], A[3][0] = A[3][0], A[1][2]
    return with_rows(one, A)


def reversed_gains(one: Student, _: str) -> Student:
    return with_gains(one, *(-gain for gain in loop_of(one).gains))


def inverse_prefilter(one: Student, _: str) -> Student:
    loop = loop_of(one)
    assert loop.prefilter is not None
    inverse = typed(1 / float(loop.prefilter))
    return one.reporting(feedback=loop.model_copy(update={"prefilter": inverse}))


# Each slip, and the places that it can be in.
SLIPS: dict[str, tuple[Slip, tuple[str, ...]]] = {
    "hz_for_rad_s": (scaled(1 / TURN, "omega"), TABLES),
    "peak_count": (miscounted(2), TABLES),
    "peak_for_steady_state": (peak_of_step, TABLES),
    "peak_to_peak": (scaled(2.0, "K"), TABLES),
    "transient_used": (too_early, (FINAL,)),
    "carts_swapped": (swapped, (*TABLES, "model", "gains")),
    "counts_for_length": (scaled(1 / COUNT, "K"), TABLES),
    "log10_for_ln": (wrong_logarithm, TABLES),
    "factor_of_ten": (scaled(10.0, "K"), TABLES),
    "no_fit_done": (copied, (FINAL,)),
    "final_off": (scaled(1.4, "K_1"), (FINAL,)),
    "initial_off": (scaled(1.23, "omega_1"), (INITIAL,)),
    "physically_impossible": (scaled(-1.0, "zeta_1"), TABLES),
    "wrong_state_space": (exchanged_couplings, ("model",)),
    "wrong_gains": (reversed_gains, ("gains",)),
    "wrong_prefilter": (inverse_prefilter, ("gains",)),
}
# Slips that a table shows for any number of carts, with the tables, and the numbers that the flag
# names at least; it names no number that is right.
SHOWN = {
    "hz_for_rad_s": (TABLES, "omega"),
    "peak_count": ((INITIAL,), "omega"),
    "peak_for_steady_state": ((INITIAL,), "K"),
    "peak_to_peak": (TABLES, "K"),
    "carts_swapped": (TABLES, "K"),
    "counts_for_length": (TABLES, "K"),
    "log10_for_ln": ((INITIAL,), "zeta"),
    "factor_of_ten": (TABLES, "K"),
}


# ------------------------------------------------------------------------------- one slip


@pytest.mark.parametrize("carts", CARTS)
@pytest.mark.parametrize(
    ("code", "table"), [(code, table) for code, (tables, _) in SHOWN.items() for table in tables]
)
def test_a_slip_in_a_table_gets_its_flag(code, table, carts):
    """One flag names the slip, the table and the numbers that it changed."""
    if (code, carts) == ("carts_swapped", 1):
        return  # a single cart cannot be swapped
    honest, symbol = student(carts), SHOWN[code][1]
    wrong = SLIPS[code][0](honest, table)
    flag = only_flag(wrong)
    before, now = (getattr(one.reported, table) for one in (honest, wrong))
    changed = {name for name in now if now[name] != before[name]}
    named = {name for name in changed if name.startswith(symbol)}
    least = {f"K_{i}" for i in (1, carts)} if code == "carts_swapped" else named
    if code == "peak_count":
        least = {*own("omega", carts)}
    assert (flag.code, flag.evidence.get("also_in")) == (code, None)
    assert least <= set(flag.parameters) <= changed
    if code == "hz_for_rad_s":
        assert flag.evidence["ratio"] == pytest.approx(1 / TURN, rel=0.15)  # 10 % off, as by eye


@pytest.mark.parametrize("carts", CARTS)
@pytest.mark.parametrize("table", TABLES)
def test_frequencies_that_were_converted_twice_are_flagged(carts, table):
    """Frequencies in rad/s that were multiplied by 2π once more get the flag of a unit."""
    assert flags(scaled(TURN, "omega")(student(carts), table)) == ["hz_for_rad_s"]


@pytest.mark.parametrize("carts", CARTS)
@pytest.mark.parametrize("k", [1, 3])
def test_one_period_too_many_is_flagged(carts, k):
    """The count of periods is named, whether there are one, two or three."""
    assert flags(miscounted(k)(student(carts), INITIAL)) == ["peak_count"]


@pytest.mark.slow
@pytest.mark.sample
def test_gains_from_the_peak_of_a_step_with_friction_are_flagged():
    """With friction, gains read at the peaks after an edge are recognised too."""
    assert flags(peak_of_step(student(2, hide=FRICTION), INITIAL)) == ["peak_for_steady_state"]


@pytest.mark.parametrize("carts", CARTS)
@pytest.mark.parametrize("table", TABLES)
def test_a_gain_can_have_two_slips(carts, table):
    """Gains from peak to peak and in counts get both flags."""
    wrong = scaled(2 / COUNT, "K")(student(carts), table)
    assert flags(wrong) == ["peak_to_peak", "counts_for_length"]


def test_two_slips_in_one_number_get_both_flags():
    """Swapped frequencies in Hz get both flags, since neither slip alone explains them."""
    one = student(2)
    names = ["omega_1", "omega_2"]
    wrong = {n: one.value(INITIAL, m) / TURN for n, m in zip(names, names[::-1], strict=True)}
    first, second = one.reporting(initial=wrong).grade().flags
    assert (first.code, second.code) == ("hz_for_rad_s", "carts_swapped")
    assert first.evidence["together_with"] == ["carts_swapped"]


@pytest.mark.parametrize("carts", CARTS)
def test_gains_in_counts_get_one_flag_even_if_inexact(carts):
    """If all gains are in counts, there is one flag, even if one gain is also 7 % off."""
    one, names = student(carts), own("K", carts)
    counted = {n: one.value(INITIAL, n) / COUNT for n in names}
    counted[names[-1]] *= 1.07
    flag = only_flag(one.reporting(initial=counted))
    assert (flag.code, set(flag.parameters)) == ("counts_for_length", set(names))


@pytest.mark.parametrize("carts", CARTS)
def test_a_slip_found_in_one_table_explains_a_careless_number_in_the_other(carts):
    """Gains 5 % below twice the true ones prove nothing by themselves, but beside exact ones do."""
    careless = scaled(1.9, "K")(student(carts), INITIAL)
    assert "peak_to_peak" not in flags(careless)
    assert flags(scaled(2.0, "K")(careless, FINAL)) == ["peak_to_peak"]


@pytest.mark.parametrize("carts", CARTS)
def test_a_final_table_copied_from_the_first_is_flagged(carts):
    """If the final table equals the initial one in every digit, the only flag is "no fit done"."""
    one = student(carts)
    flag = only_flag(one.reporting(final=one.reported.initial))
    assert (flag.code, set(flag.parameters)) == ("no_fit_done", set(one.reported.initial))


@pytest.mark.parametrize(
    ("carts", "table", "changes", "code", "parameters"),
    [
        *((n, FINAL, {own("omega", n)[0]: 1.33}, "final_off", None) for n in CARTS),
        *((n, INITIAL, {own("K", n)[-1]: 0.81}, "initial_off", None) for n in CARTS),
        # with the wrong logarithm, all dampings would be too small
        *((n, INITIAL, {"zeta_1": np.log10(np.e)}, "initial_off", None) for n in (2, 3)),
        (3, FINAL, {"omega_2": 1.4}, "final_off", None),  # it also breaks the order: one flag
        (2, FINAL, {"zeta_a": -1.0}, "physically_impossible", None),
        (2, FINAL, {"K_2": 1.85}, "physically_impossible", ("K_2", "K_1")),
    ],
)  # fmt: skip
def test_a_wrong_number_gets_one_flag(carts, table, changes, code, parameters):
    """A number that no slip explains is only off; one that no carts have is impossible."""
    one = student(carts)
    wrong = {name: factor * one.value(table, name) for name, factor in changes.items()}
    flag = only_flag(with_table(one, table, wrong))
    assert (flag.code, flag.parameters) == (code, parameters or tuple(changes))
    if code == "final_off":  # the flag gives the number that the recordings give
        (name,) = changes
        assert flag.evidence["recomputed"] == pytest.approx(one.value(table, name), rel=0.02)
        assert f"{flag.evidence['recomputed']:.4g}" in flag.message


@pytest.mark.parametrize("vague", ["0e2", "0.0"])
@pytest.mark.parametrize("carts", CARTS)
def test_zeros_earn_nothing(carts, vague):
    """Zeros are flagged as impossible once a table, however they are typed, and earn no points."""
    one, size = student(carts), 2 * carts
    zeros = dict.fromkeys(one.rubric.names, Decimal(vague))
    space = ReportedStateSpace(A=((Decimal(vague),) * size,) * size, B=(Decimal(vague),) * size)
    grade = one.reporting(initial=zeros, final=zeros, state_space=space).grade()
    told = [flag.message for flag in grade.flags if flag.code == "physically_impossible"]
    assert len(told) == len(set(told)) == 2
    tables = [c for c in grade.criteria if c.id.split("-")[0] in FROM_TABLES]
    assert tables
    assert sum(c.points for c in tables) == 0
    undamped = {name: zero for name, zero in zeros.items() if name.startswith("zeta")}
    grade = one.reporting(final=undamped).grade()
    (flag,) = [flag for flag in grade.flags if flag.code == "physically_impossible"]
    assert set(flag.parameters) == set(undamped)
    assert {c.points for c in grade.criteria if c.id in ("final-dampings", "laws")} == {0}


def test_a_number_not_reported_is_missing():
    """A missing number is named; if a whole table is missing, one flag names all."""
    one = student(2)
    flag = only_flag(one.without(FINAL, "zeta_b"))
    assert (flag.code, flag.parameters) == ("missing", ("final.zeta_b",))
    assert flags(reporting(one, Reported(initial=one.reported.initial))) == ["missing"]


# ------------------------------------------------------------------- state model and gains


def flip(A: list, n: int) -> list:
    A[1][1] = -A[1][1]
    return A


def positions_first(A: list, n: int) -> list:
    order = [*range(0, 2 * n, 2), *range(1, 2 * n, 2)]
    return [[A[i][j] for j in order] for i in order]


def no_square(A: list, n: int) -> list:
    for i in range(n):
        A[2 * i + 1][2 * i] = typed(-np.sqrt(abs(float(A[2 * i + 1][2 * i]))))
    return A


def exchanged(A: list, n: int) -> list:
    A[1][2], A[3][0] = A[3][0], A[1][2]
    return A


@pytest.mark.parametrize("carts", [2, 3])
@pytest.mark.parametrize(
    ("slip", "word"),
    [(flip, "A(2, 2)"), (positions_first, "x1, x2"), (no_square, "ω²"), (exchanged, "exchanged")],
)
def test_a_single_slip_in_a_state_model_is_named(carts, slip, word):
    """If a single known slip explains a wrong state model, the message names it."""
    one = student(carts)
    flag = only_flag(with_rows(one, slip([list(row) for row in space_of(one).A], carts)))
    assert flag.code == "wrong_state_space"
    assert word in flag.message


def test_a_state_model_that_follows_from_a_wrong_table_is_right():
    """A state model built correctly from frequencies in Hz gets only the flag for Hz."""
    one = student(1)
    hertz, zeta = one.value(FINAL, "omega_n") / TURN, one.value(FINAL, "zeta")
    row = [typed(-(hertz**2)), typed(-2 * zeta * hertz)]
    wrong = with_rows(one, [list(space_of(one).A[0]), row]).reporting(final={"omega_n": hertz})
    assert flags(wrong) == ["hz_for_rad_s"]


@pytest.mark.parametrize("carts", CARTS)
@pytest.mark.parametrize(
    ("code", "word"), [("wrong_gains", "reversed"), ("wrong_prefilter", "reciprocal")]
)
def test_wrong_gains_and_wrong_prefilters_are_told_apart(carts, code, word):
    """Gains of reversed sign are wrong gains; a prefilter equal to the static gain is one too."""
    flag = only_flag(SLIPS[code][0](student(carts), "gains"))
    assert flag.code == code
    assert word in flag.message


def test_gains_that_contradict_the_reported_settling_time_are_flagged():
    """Gains 2.5 times too large cannot give the settling time that the student reported."""
    one = student(1)
    runs = [e.model_copy(update={"controller": None}) for e in one.submission.experiments]
    submission = one.submission.model_copy(update={"experiments": tuple(runs)})
    wrong = with_gains(
        replace(one, submission=submission), *(2.5 * float(g) for g in loop_of(one).gains)
    )
    assert flags(wrong) == ["wrong_gains"]


def test_gains_that_cancel_all_stiffness_are_judged():
    """Gains that cancel all stiffness are judged wrong, although no prefilter exists for them."""
    wrong = with_gains(student(1).reporting(final={"K": 4}), Decimal("-0.25"), Decimal("0.01"))
    assert "wrong_gains" in flags(wrong)


# ------------------------------------------------------------------------- charged once


def losses(honest: Student, one: Student) -> dict[str, float]:
    """Return the points that each criterion lost; criteria without a loss are left out."""
    had = {c.id: c.points for c in honest.grade().criteria}
    has = {c.id: c.points for c in one.grade().criteria}
    return {id_: had[id_] - has[id_] for id_ in had if had[id_] != has[id_]}


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("code", sorted(SLIPS))
def test_a_slip_in_every_table_costs_no_more_than_in_its_dearest_criterion(code):
    """A slip in every place at once costs points, but no more than in its dearest criterion."""
    (slip, places), honest = SLIPS[code], student(2)
    alone = [losses(honest, slip(honest, place)) for place in places]
    everywhere = losses(honest, reduce(slip, places, honest))
    dearest = max(loss for lost in alone for loss in lost.values())
    assert 0 < sum(everywhere.values()) <= dearest


def test_one_slip_in_both_tables_gets_one_flag_and_is_charged_once():
    """Frequencies in Hz in both tables cost points in one criterion; the other says why not.

    Messages of the criteria then omit their usual advice.
    """
    grade = reduce(SLIPS["hz_for_rad_s"][0], TABLES, student(2)).grade()
    (flag,) = grade.flags
    assert (flag.evidence["table"], flag.evidence["also_in"]) == TABLES
    assert flag.code == "hz_for_rad_s"
    (lost,) = [c for c in grade.criteria if c.points < c.out_of]
    assert lost.id == "final-frequencies"
    decays = criterion(grade, "initial-decays")
    advice = next(c.message for c in student(2).rubric.criteria if c.id == decays.id)
    assert lost.title in decays.message
    assert advice not in decays.message


# ------------------------------------------------------------------------------ honest


def rounded(table: Mapping[str, Any], digits: int) -> dict[str, Decimal]:
    return {name: Decimal(f"{float(value):.{digits - 1}e}") for name, value in table.items()}


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(("carts", "hide"), [(1, ()), (2, ()), (3, ()), (2, FRICTION)])
def test_an_honest_student_gets_no_flag(carts, hide):
    """Students who round, make small errors, guess dampings or have a sticking cart are honest.

    So are those who use textbook methods and fit the last cart first.
    """
    one = student(carts, hide=hide)
    assert one.grade().flags == ()
    assert one.grade().points >= 0.95 * one.rubric.out_of
    records = one.analysis.records
    initial = (by_eye(records, carts) if carts > 1 else {}) | initial_table(records, carts)
    final = final_table(records, carts, initial)
    tables = ({n: typed(v) for n, v in table.items()} for table in (initial, final))
    by_hand = reporting(one, Reported(**dict(zip(TABLES, tables, strict=True))))
    assert set(flags(by_hand)) <= {"missing"}


@pytest.mark.parametrize("carts", CARTS)
def test_numbers_typed_with_few_digits_are_honest_too(carts):
    """Two digits, as in the paper's tables, get no flag; equal digits of a fit prove nothing."""
    one = student(carts)
    initial, final = (rounded(getattr(one.reported, table), 2) for table in TABLES)
    assert flags(one.reporting(initial=initial, final=final)) == []
    if carts > 1:
        same = rounded(one.reported.final, 1)
        assert "no_fit_done" not in flags(one.reporting(initial=same, final=same))


@pytest.mark.parametrize("digits", [2, 3])
def test_equal_initial_and_final_estimates_may_be_honest(digits):
    """For one cart on a quiet bench, equal initial and final estimates get no flag."""
    one = student(1)
    right = {row.name: row.final.value for row in one.analysis.rows if row.final}
    table = rounded(right, digits)
    assert flags(one.reporting(initial=table, final=table)) == []


@pytest.mark.parametrize("carts", [2, 3])
def test_the_order_in_which_numbers_are_listed_does_not_matter(carts):
    """A student may list the numbers in any order, for example the last cart first."""
    one = student(carts)
    tables = {table: dict(reversed(getattr(one.reported, table).items())) for table in TABLES}
    turned = reporting(one, one.reported.model_copy(update=tables))
    assert flags(turned) == []
    wrong = turned.reporting(final={"K_2": 1.25 * one.value(FINAL, "K_1")})
    assert only_flag(wrong).code == "physically_impossible"
