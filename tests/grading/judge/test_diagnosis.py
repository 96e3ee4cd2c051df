"""Each known mistake gets its own flag and no other; an honest student gets no flag."""

from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest

from pipeline.grading.grade import Flag
from pipeline.submission import Reported, ReportedStateSpace
from tests.helpers.grading_students import Student, student, typed
from tests.helpers.textbook_student import by_eye, final_table, initial_table

TURN = 2 * np.pi
FRICTION = ("coulomb_friction",)
FROM_TABLES = {"initial", "final", "comparison", "laws", "state"}  # ids begin with these


def codes(one: Student) -> list[str]:
    return [flag.code for flag in one.grade().flags]


def only_flag(one: Student) -> Flag:
    (flag,) = one.grade().flags
    return flag


def own(start: str, n: int) -> list[str]:
    if n == 1:
        return ["omega_n" if start == "omega" else start]
    return [f"{start}_{i}" for i in range(1, n + 1)]


def with_table(one: Student, table: str, numbers: dict[str, float]) -> Student:
    return one.reporting(initial=numbers) if table == "initial" else one.reporting(final=numbers)


def scaled(one: Student, table: str, names: list[str], factor: float) -> Student:
    return with_table(one, table, {n: factor * one.value(table, n) for n in names})


@pytest.mark.parametrize(("carts", "hide"), [(1, ()), (2, ()), (3, ()), (2, FRICTION)])
def test_an_honest_student_gets_no_flag(carts, hide):
    """An honest student gets no flag.

    Students who round, make small errors, guess dampings or have a sticking cart are honest.
    """
    one = student(carts, hide=hide)
    assert one.grade().flags == ()
    assert one.grade().points >= 0.95 * one.rubric.out_of


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_numbers_typed_with_two_digits_are_honest_too(carts):
    """Numbers typed with two digits, as in the paper's tables, get no flag."""
    one = student(carts)
    coarse = {
        table: {n: Decimal(f"{float(v):.1e}") for n, v in getattr(one.reported, table).items()}
        for table in ("initial", "final")
    }
    assert codes(one.reporting(initial=coarse["initial"], final=coarse["final"])) == []


@pytest.mark.parametrize(("carts", "hide"), [(1, ()), (2, ()), (3, ()), (2, FRICTION)])
def test_textbook_methods_get_no_flag(carts, hide):
    """A student who uses textbook methods and fits the last cart first gets no flag."""
    one = student(carts, hide=hide)
    records = one.analysis.records
    initial = by_eye(records, carts) if carts > 1 else {}
    initial |= initial_table(records, carts)
    reported = Reported(
        initial={n: typed(v) for n, v in initial.items()},
        final={n: typed(v) for n, v in final_table(records, carts, initial).items()},
    )
    submission = one.submission.model_copy(update={"reported": reported})
    assert set(codes(replace(one, submission=submission))) <= {"missing"}


@pytest.mark.parametrize("digits", [2, 3])
def test_equal_initial_and_final_estimates_may_be_honest(digits):
    """For one cart on a quiet bench, equal initial and final estimates get no flag."""
    one = student(1)
    right = {row.name: row.final.value for row in one.analysis.rows if row.final}
    table = {name: Decimal(f"{value:.{digits - 1}e}") for name, value in right.items()}
    assert codes(one.reporting(initial=table, final=table)) == []


@pytest.mark.parametrize("carts", [2, 3])
def test_the_order_in_which_numbers_are_listed_does_not_matter(carts):
    """A student may list the numbers in any order, for example the last cart first."""
    one = student(carts)
    reported = one.reported.model_copy(
        update={
            "initial": dict(reversed(one.reported.initial.items())),
            "final": dict(reversed(one.reported.final.items())),
        }
    )
    submission = one.submission.model_copy(update={"reported": reported})
    assert codes(replace(one, submission=submission)) == []
    swapped = replace(one, submission=submission).reporting(
        final={"K_2": 1.25 * one.value("final", "K_1")}
    )
    assert only_flag(swapped).code == "physically_impossible"


def test_unreported_final_numbers_are_flagged_as_missing():
    """If only initial estimates are reported, all other numbers are flagged as missing."""
    one = student(2)
    reported = Reported(initial=one.reported.initial)
    submission = one.submission.model_copy(update={"reported": reported})
    assert codes(replace(one, submission=submission)) == ["missing"]


@pytest.mark.parametrize("carts", [1, 2, 3])
@pytest.mark.parametrize("table", ["initial", "final"])
def test_frequencies_in_hz_are_flagged(carts, table):
    """If all frequencies of a table are divided by 2π, the flag says Hz and gives the ratio."""
    one = student(carts)
    names = [n for n in getattr(one.reported, table) if n.startswith("omega")]
    flag = only_flag(scaled(one, table, names, 1 / TURN))
    assert flag.code == "hz_for_rad_s"
    assert set(flag.parameters) == set(names)
    assert flag.evidence["ratio"] == pytest.approx(1 / TURN, rel=0.15)  # 10 % off, as by eye
    assert "/2π" in flag.message
    assert "also_in" not in flag.evidence


def test_one_mistake_in_two_tables_gets_one_flag():
    """If the frequencies of both tables are in Hz, one flag names them all.

    Messages of the criteria then omit their usual advice.
    """
    one = student(2)
    names = [n for n in one.reported.final if n.startswith("omega")]
    hertz = scaled(scaled(one, "initial", names, 1 / TURN), "final", names, 1 / TURN).grade()
    (flag,) = hertz.flags
    assert "first estimate" in flag.message
    assert (flag.evidence["table"], flag.evidence["also_in"]) == ("initial", "final")
    assert flag.message.endswith("Your final estimates have the same mistake.")
    said = {c.id: c.message for c in hertz.criteria}
    advice = {c.id: c.message for c in one.rubric.criteria if c.message}
    assert advice["initial-decays"] not in said["initial-decays"]


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_gains_in_counts_get_one_flag_even_if_inexact(carts):
    """If all gains are in counts, there is one flag, even if one gain is also 7 % off."""
    one, names = student(carts), own("K", carts)
    counted = {n: one.value("initial", n) / 0.00227 for n in names}
    counted[names[-1]] *= 1.07
    flag = only_flag(one.reporting(initial=counted))
    assert (flag.code, set(flag.parameters)) == ("counts_for_length", set(names))


@pytest.mark.parametrize("carts", [2, 3])
def test_a_single_wrong_damping_is_not_a_wrong_logarithm(carts):
    """A single damping that is 2.3 times too small is not flagged as log10 instead of ln.

    With that mistake, all dampings would be too small.
    """
    one = student(carts)
    flag = only_flag(scaled(one, "initial", ["zeta_1"], np.log10(np.e)))
    assert (flag.code, flag.parameters) == ("initial_off", ("zeta_1",))


@pytest.mark.parametrize("carts", [1, 2, 3])
@pytest.mark.parametrize("k", [1, 2, 3])
def test_one_period_too_many_is_flagged(carts, k):
    """If k + 1 periods were counted instead of k, a flag says so.

    Then ω is (k + 1)/k times too large, and ζ is too small by the same factor.
    """
    one = student(carts)
    omegas, zetas = own("omega", carts), own("zeta", carts)
    wrong = scaled(one, "initial", omegas, (k + 1) / k)
    flag = only_flag(scaled(wrong, "initial", zetas, k / (k + 1)))
    assert flag.code == "peak_count"
    assert set(omegas) <= set(flag.parameters)


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_decrement_with_log10_is_flagged(carts):
    """If every ζ of the decays is 2.303 times too small, the flag says log10 instead of ln."""
    one = student(carts)
    flag = only_flag(scaled(one, "initial", own("zeta", carts), np.log10(np.e)))
    assert flag.code == "log10_for_ln"
    assert flag.parameters == tuple(own("zeta", carts))


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_mistake_found_in_one_table_explains_a_careless_number_in_the_other(carts):
    """Gains 5 % below twice the true ones prove nothing by themselves, but beside exact ones do."""
    one, names = student(carts), own("K", carts)
    careless = scaled(one, "initial", names, 1.9)
    assert "peak_to_peak" not in codes(careless)
    assert codes(scaled(careless, "final", names, 2.0)) == ["peak_to_peak"]


@pytest.mark.parametrize("carts", [1, 2, 3])
@pytest.mark.parametrize("table", ["initial", "final"])
def test_gains_from_peak_to_peak_and_in_counts_are_flagged(carts, table):
    """Gains that are twice the true gains are flagged as read from peak to peak.

    Gains divided by the encoder step are flagged as counts; a gain can have both flags.
    """
    one, names = student(carts), own("K", carts)
    count = 0.00227  # cm per count of the simulated encoder
    assert codes(scaled(one, table, names, 2.0)) == ["peak_to_peak"]
    assert codes(scaled(one, table, names, 1 / count)) == ["counts_for_length"]
    both = codes(scaled(one, table, names, 2 / count))
    assert both == ["peak_to_peak", "counts_for_length"]


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_gain_from_the_peak_of_the_step_is_flagged(carts):
    """A gain read at the peak of the step instead of its settled level is flagged as such."""
    one = student(carts)
    record = next(r for r in one.analysis.records if r.kind == "step")
    assert record.u is not None
    on = np.flatnonzero(record.u)
    moved = record.y[:, on] - record.y[:, :1]
    peaks = (moved / record.u[on]).max(axis=1)
    flag = only_flag(one.reporting(initial=dict(zip(own("K", carts), peaks.tolist(), strict=True))))
    assert flag.code == "peak_for_steady_state"
    assert flag.parameters == tuple(own("K", carts))


@pytest.mark.parametrize("vague", ["0e2", "0.0"])
@pytest.mark.parametrize("carts", [1, 2, 3])
def test_zeros_earn_nothing(carts, vague):
    """Zeros are flagged as physically impossible, however they are typed, and earn no points."""
    one = student(carts)
    zeros = dict.fromkeys(one.rubric.names, Decimal(vague))
    space = ReportedStateSpace(
        A=tuple((Decimal(vague),) * (2 * carts) for _ in range(2 * carts)),
        B=(Decimal(vague),) * (2 * carts),
    )
    grade = one.reporting(initial=zeros, final=zeros, state_space=space).grade()
    told = [flag.message for flag in grade.flags if flag.code == "physically_impossible"]
    assert len(told) == len(set(told)) == 2  # one message for each table
    assert all(vague in message for message in told)
    tables = [c for c in grade.criteria if c.id.split("-")[0] in FROM_TABLES]
    assert tables
    assert sum(c.points for c in tables) == 0
    undamped = {name: zero for name, zero in zeros.items() if name.startswith("zeta")}
    grade = one.reporting(final=undamped).grade()
    (flag,) = [flag for flag in grade.flags if flag.code == "physically_impossible"]
    assert set(flag.parameters) == set(undamped)
    assert {c.points for c in grade.criteria if c.id in ("final-dampings", "laws")} == {0}


@pytest.mark.parametrize("hide", [(), FRICTION])
def test_gains_from_the_peak_of_one_edge_are_flagged(hide):
    """Gains read at the peaks after one edge of the step are recognised, even with friction."""
    one = student(2, hide=hide)
    record = next(r for r in one.analysis.records if r.kind == "step")
    assert record.u is not None
    on = np.flatnonzero(record.u)
    peaks = ((record.y[:, on] - record.y[:, :1]) / record.u[on]).max(axis=1)
    flag = only_flag(one.reporting(initial={"K_1": peaks[0], "K_2": peaks[1]}))
    assert flag.code == "peak_for_steady_state"


@pytest.mark.parametrize("carts", [2, 3])
@pytest.mark.parametrize("table", ["initial", "final"])
def test_swapped_carts_are_flagged(carts, table):
    """If the numbers of the first and the last cart are swapped, a flag says so."""
    one = student(carts)
    swapped = {}
    for symbol in ("K", "omega", "zeta"):
        first, last = f"{symbol}_1", f"{symbol}_{carts}"
        swapped |= {first: one.value(table, last), last: one.value(table, first)}
    flag = only_flag(with_table(one, table, swapped))
    assert flag.code == "carts_swapped"
    assert {"K_1", f"K_{carts}"} <= set(flag.parameters)


def test_two_mistakes_in_one_number_get_both_flags():
    """Swapped frequencies in Hz get both flags, since neither mistake alone explains them."""
    one = student(2)
    wrong = {
        "omega_1": one.value("initial", "omega_2") / TURN,
        "omega_2": one.value("initial", "omega_1") / TURN,
    }
    flags = one.reporting(initial=wrong).grade().flags
    assert [flag.code for flag in flags] == ["hz_for_rad_s", "carts_swapped"]
    assert flags[0].evidence["together_with"] == ["carts_swapped"]


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_final_table_copied_from_the_first_is_flagged(carts):
    """If the final table equals the initial one in every digit, the only flag is "no fit done"."""
    one = student(carts)
    flag = only_flag(one.reporting(final=one.reported.initial))
    assert flag.code == "no_fit_done"
    assert set(flag.parameters) == set(one.reported.initial)


@pytest.mark.parametrize("carts", [2, 3])
def test_equal_tables_of_single_digits_get_no_flag(carts):
    """Equal tables of one-digit numbers get no flag, since a fit could give the same digits."""
    one = student(carts)
    coarse = {n: Decimal(f"{float(v):.0e}") for n, v in one.reported.final.items()}
    assert "no_fit_done" not in codes(one.reporting(initial=coarse, final=coarse))


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_number_that_no_mistake_explains_is_only_off(carts):
    """If no named mistake explains a wrong number, the flag only says that it is off."""
    one = student(carts)
    omega, gain = own("omega", carts)[0], own("K", carts)[-1]
    flag = only_flag(scaled(one, "final", [omega], 1.33))
    assert (flag.code, flag.parameters) == ("final_off", (omega,))
    flag = only_flag(scaled(one, "initial", [gain], 0.81))
    assert (flag.code, flag.parameters) == ("initial_off", (gain,))


def test_a_frequency_out_of_order_gets_one_flag():
    """A wrong ω_2 gets one flag, even if it also breaks the order of the frequencies.

    The flag's message gives the frequency computed from the recordings.
    """
    one = student(3)
    flag = only_flag(scaled(one, "final", ["omega_2"], 1.4))
    assert (flag.code, flag.parameters) == ("final_off", ("omega_2",))
    recomputed = flag.evidence["recomputed"]
    assert recomputed == pytest.approx(one.value("final", "omega_2"), rel=0.02)
    assert f"your recordings give {recomputed:.4g}" in flag.message


def test_impossible_numbers_are_flagged():
    """A negative damping is flagged as impossible, and so is a K_2 larger than K_1."""
    one = student(2)
    flag = only_flag(scaled(one, "final", ["zeta_a"], -1.0))
    assert (flag.code, flag.parameters) == ("physically_impossible", ("zeta_a",))
    flag = only_flag(one.reporting(final={"K_2": 1.25 * one.value("final", "K_1")}))
    assert (flag.code, flag.parameters) == ("physically_impossible", ("K_2", "K_1"))


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
    ("slip", "said"),
    [
        (flip, "the sign of A(2, 2) is reversed"),
        (positions_first, "A has its states in the order x1, x2"),
        (no_square, "ω where ω² belongs"),
        (exchanged, "exchanged"),
    ],
)
def test_a_single_slip_in_a_state_model_is_named(carts, slip: Callable, said):
    """If a single known mistake explains a wrong state model, the message names it."""
    one = student(carts)
    space = one.reported.state_space
    assert space is not None
    A = slip([list(row) for row in space.A], carts)
    changed = space.model_copy(update={"A": tuple(map(tuple, A))})
    flag = only_flag(one.reporting(state_space=changed))
    assert flag.code == "wrong_state_space"
    assert said in flag.message


def test_a_state_model_that_follows_from_a_wrong_table_is_right():
    """A state model built correctly from frequencies in Hz gets only the flag for Hz."""
    one = student(1)
    hertz = one.value("final", "omega_n") / TURN
    space = one.reported.state_space
    assert space is not None
    zeta = one.value("final", "zeta")
    row = (typed(-(hertz**2)), typed(-2 * zeta * hertz))
    changed = space.model_copy(update={"A": (space.A[0], row)})
    assert codes(one.reporting(final={"omega_n": hertz}, state_space=changed)) == ["hz_for_rad_s"]


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_wrong_gains_and_wrong_prefilters_are_told_apart(carts):
    """Gains of reversed sign are flagged as wrong gains.

    A prefilter equal to the static gain is flagged as a wrong prefilter.
    """
    one = student(carts)
    feedback = one.reported.feedback
    assert feedback is not None
    assert feedback.prefilter is not None
    gains = feedback.model_copy(update={"gains": tuple(-g for g in feedback.gains)})
    flag = only_flag(one.reporting(feedback=gains))
    assert flag.code == "wrong_gains"
    assert "signs are reversed" in flag.message
    inverse = feedback.model_copy(update={"prefilter": typed(1 / float(feedback.prefilter))})
    flag = only_flag(one.reporting(feedback=inverse))
    assert flag.code == "wrong_prefilter"
    assert "take its reciprocal" in flag.message


def test_gains_that_contradict_the_reported_settling_time_are_flagged():
    """If the gains cannot give the settling time that the student reported, they are flagged.

    In the test, the gains are 2.5 times too large.
    """
    one = student(1)
    feedback = one.reported.feedback
    assert feedback is not None
    gains = feedback.model_copy(
        update={"gains": tuple(typed(2.5 * float(g)) for g in feedback.gains)}
    )
    runs = [e.model_copy(update={"controller": None}) for e in one.submission.experiments]
    submission = one.submission.model_copy(update={"experiments": tuple(runs)})
    flag = only_flag(replace(one, submission=submission).reporting(feedback=gains))
    assert flag.code == "wrong_gains"


def test_a_number_not_reported_is_flagged_as_missing():
    """A number that was not reported is flagged as missing."""
    one = student(2).without("final", "zeta_b")
    flag = only_flag(one)
    assert (flag.code, flag.parameters) == ("missing", ("final.zeta_b",))


def test_gains_that_cancel_all_stiffness_are_judged():
    """Gains that cancel all stiffness are judged wrong, although no prefilter exists for them."""
    one = student(1)
    feedback = one.reported.feedback
    assert feedback is not None
    cancelling = feedback.model_copy(update={"gains": (Decimal("-0.25"), Decimal("0.01"))})
    assert "wrong_gains" in codes(one.reporting(final={"K": 4}, feedback=cancelling))
