"""Copied tables of reported numbers are found, and honest teams on one bench are not flagged."""

import numpy as np
import pytest

from pipeline.grading.batch.runner import grade_batch
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Example, Grading, Setup
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.publish.pseudonyms import anonymise
from pipeline.grading.similarity.copies import SharedRecord
from pipeline.grading.similarity.shared_flag import find_clusters, shared_flag, student_message
from pipeline.grading.similarity.tables import TypedNumber, find_shared_tables
from tests.helpers.grades import make_grade, make_outcome, two_cart_rubric

# Numbers of the preset with two carts; the errors are those of honest students: static gains and
# frequencies within 1 %, dampings within 5 %.
TRUE = {
    "K_1": 24.28, "K_2": 16.43, "omega_1": 20.19, "omega_2": 32.93,
    "omega_a": 10.14, "omega_b": 37.27,
    "zeta_1": 0.05276, "zeta_2": 0.03853, "zeta_a": 0.1098, "zeta_b": 0.03275,
}  # fmt: skip
TABLES = "initial", "final"


def rounded(value, digits):
    return float(f"{value:.{digits - 1}e}")


def team(seed, *, digits=3, bench=0.0, repeats=0.001, careless=1.0, factor=1.0, program=None):
    """Return what an honest team reports, and what its recordings give.

    Parameters
    ----------
    repeats : relative spread of the runs on one bench.
    program : seed of the errors, if a program makes them.
    bench : relative spread of the benches; all numbers of a kind change together.
    careless : size of the errors, as a multiple of the usual size.
    factor : a slip that all frequencies have.
    """
    rng = np.random.default_rng(seed)
    errors = rng if program is None else np.random.default_rng(program)
    found = {}
    other = {kind: 1 + bench * rng.standard_normal() for kind in ("K", "o", "z")}
    for table in TABLES:
        for name, true in TRUE.items():
            run = true * other[name[0]] * (1 + repeats * rng.standard_normal())
            error = careless * (0.05 if name[0] == "z" else 0.01) * errors.standard_normal()
            typed = run * (1 + error) * (factor if name[0] == "o" else 1)
            found[table, name] = TypedNumber(value=rounded(typed, digits), recomputed=run)
    return found


def copied(mine, other, *, keep=()):
    """Return the numbers of another team as reported by a team with its own recordings."""
    return {
        key: number
        if key[0] in keep
        else TypedNumber(value=other[key].value, recomputed=number.recomputed)
        for key, number in mine.items()
    }


def members(names, **authors):
    return [Grading(submission=n, authors=(authors.get(n, f"s-{n}"),)) for n in names]


def shared(numbers, **authors):
    named = {f"t{number:03d}": own for number, own in enumerate(numbers)}
    return find_shared_tables(members(named, **authors), named)


@pytest.mark.parametrize("bench", [0.0, 0.1])
@pytest.mark.parametrize("n", [5, 12, 40])
def test_a_copied_table_is_found_and_nobody_else(n, bench):
    """A copied table is flagged for both teams; the flag says which one and how many numbers."""
    numbers = [team(seed, bench=bench) for seed in range(n)]
    numbers[3] = copied(numbers[3], numbers[1])
    found = shared(numbers)
    assert set(found) == {"t001", "t003"}
    assert [(t.table, t.submission, t.equal, t.of) for t in found["t003"]] == [
        ("initial", "t001", 10, 10),
        ("final", "t001", 10, 10),
    ]


@pytest.mark.parametrize("digits", [2, 3, 4])
@pytest.mark.parametrize("careless", [0.0, 0.1, 1.0])
def test_honest_teams_on_one_bench_are_not_flagged(digits, careless):
    """In a class of 300 on one bench, nobody is flagged, however carefully the teams worked."""
    assert shared([team(s, digits=digits, careless=careless) for s in range(300)]) == {}


@pytest.mark.parametrize("digits", [2, 3, 4])
def test_two_careful_teams_in_a_careless_class_are_not_flagged(digits):
    """Right numbers of equal data prove nothing, even if all others are far from right."""
    careful = [team(seed, digits=digits, careless=0.0) for seed in (1, 2)]
    assert shared([*careful, *(team(seed) for seed in range(3, 20))]) == {}
    if digits < 4:  # the fourth digit differs from run to run
        alike = copied(careful[1], careful[0])
        assert shared([careful[0], alike, *(team(seed) for seed in range(3, 20))]) == {}


def test_a_class_of_exact_numbers_is_not_judged():
    """If most teams report exactly what cartlab computes, no spread of errors is known."""
    exact = [
        {k: TypedNumber(value=one.recomputed, recomputed=one.recomputed) for k, one in own.items()}
        for own in (team(seed, repeats=0.05) for seed in range(12))
    ]
    exact[3] = copied(exact[3], exact[1])
    assert shared(exact) == {}


def test_numbers_from_equal_recordings_accuse_nobody():
    """Teams that analysed the same recordings in the same way may report the same errors."""
    one = team(1)
    assert shared([one, dict(one), *(team(seed) for seed in range(2, 12))]) == {}


@pytest.mark.parametrize("digits", [3, 4])
def test_one_faulty_program_is_a_possible_reason_for_equal_tables(digits):
    """Teams that share a program, on a bench repeatable to 0.01 %, are asked and not accused."""
    asked = 0
    for seed in range(60):
        pair = [
            team(s, digits=digits, repeats=1e-4, program=7000 + seed) for s in (seed, 100 + seed)
        ]
        found = shared([*pair, *(team(200 + 20 * seed + k, digits=digits) for k in range(10))])
        assert all(one.one_program for tables in found.values() for one in tables)
        if found:
            asked += 1
            assert "program" in shared_flag([], found["t000"]).message
    assert asked or digits > 3


@pytest.mark.parametrize(("digits", "repeats"), [(3, 0.01), (4, 0.001)])
def test_no_program_explains_equal_numbers_of_recordings_that_differ(digits, repeats):
    """If the recordings differ by more than the last digit, a copied table is said to be one."""
    numbers = [team(seed, digits=digits, repeats=repeats) for seed in range(10)]
    numbers[3] = copied(numbers[3], numbers[1])
    found = shared(numbers)
    assert set(found) == {"t001", "t003"}
    assert not any(one.one_program for one in found["t003"])
    assert "program" not in shared_flag([], found["t003"]).message


def test_the_same_slip_accuses_nobody():
    """Two teams that report Hz for rad/s have the same large error, not the same source."""
    slips = [team(seed, careless=0.0, factor=1 / (2 * np.pi)) for seed in (1, 2)]
    alike = copied(slips[1], slips[0])
    assert shared([slips[0], alike, *(team(seed) for seed in range(3, 12))]) == {}


def test_teammates_small_classes_and_given_numbers_are_not_flagged():
    """Nobody is flagged for teammates' numbers, given numbers, or in a class of four."""
    numbers = [team(seed) for seed in range(8)]
    numbers[3] = copied(numbers[3], numbers[1])
    assert shared(numbers)
    assert shared(numbers, t001="ann", t003="Ann") == {}
    assert shared(numbers[:4]) == {}
    named = {f"t{number:03d}": own for number, own in enumerate(numbers)}
    given = {(name, number.value) for (_, name), number in numbers[1].items()}
    assert find_shared_tables(members(named), named, given=given) == {}
    most = [copied(own, numbers[1]) for own in numbers[:5]]
    assert shared([*most, *numbers[5:]]) == {}


def test_one_changed_table_leaves_the_other():
    """A table that was copied alone is named alone; a few changed numbers do not hide it."""
    numbers = [team(seed) for seed in range(10)]
    numbers[4] = copied(numbers[4], numbers[2], keep=["initial"])
    key = "final", "K_1"
    numbers[4][key] = TypedNumber(value=99.0, recomputed=numbers[4][key].recomputed)
    found = shared(numbers)
    assert [(t.table, t.equal, t.of) for t in found["t002"]] == [("final", 9, 10)]


def test_two_copies_of_a_table_of_few_numbers_prove_little():
    """Six numbers of a single cart are not enough, since honest teams may agree by chance."""
    names = "K_1", "omega_1", "zeta_1"
    numbers = [{k: v for k, v in team(s).items() if k[1] in names} for s in range(12)]
    numbers[3] = copied(numbers[3], numbers[1])
    assert shared(numbers) == {}


def record(submission):
    return SharedRecord(
        experiment="step-1", submission=submission, other_experiment="step-2", sigmas=9.0,
        equal_rows=800, delay=None, time=(0.0, 4.0), other_time=(0.0, 4.0),
    )  # fmt: skip


@pytest.mark.parametrize("with_recording", [False, True])
def test_the_flag_reads_well_and_students_learn_no_name(with_recording):
    """The message tells recordings and tables apart; a student's message names no team."""
    numbers = [team(seed, repeats=0.01) for seed in range(10)]
    numbers[3] = copied(numbers[3], numbers[1])
    found = shared(numbers)
    flag = shared_flag([record("t001")] if with_recording else [], found["t003"])
    assert "all 20 " in flag.message
    assert ("step-1" in flag.message, "recording" in flag.message) == (with_recording,) * 2
    assert student_message(flag) == flag.message.replace("t001", "another submission")
    hidden = anonymise(make_grade("t003", flags=(flag,)), {"t003": "anon-3", "t001": "anon-1"})
    assert "t001" not in repr(hidden)
    assert hidden.flags[0].evidence["tables"][1]["submission"] == "anon-1"

    flags = {"t003": flag, "t001": shared_flag([], found["t001"])}
    (cluster,) = find_clusters(flags)
    ((names, what),) = cluster.by_submissions().items()
    assert names == ("t001", "t003")
    assert [w for w in what if w.startswith("reported")] == ["reported.final", "reported.initial"]


def test_a_class_with_a_copied_table_is_flagged_as_it_is_graded(tmp_path):
    """The flag comes from the numbers in the grades; examples are asked before it is given."""
    rubric = two_cart_rubric()
    tables = {asked.id: asked.check for asked in rubric.criteria}
    numbers = [team(seed) for seed in range(6)]
    numbers[3] = copied(numbers[3], numbers[1])
    for number in range(6):
        (tmp_path / "in" / f"t{number}").mkdir(parents=True)
        (tmp_path / "in" / f"t{number}" / "submission.toml").write_text(f"# {number}")

    def judged(criterion, own):
        typed = {name: x for (table, name), x in own.items() if table == tables[criterion.id]}
        found = {name: x.value for name, x in typed.items()}
        expected = {name: x.recomputed for name, x in typed.items()}
        return criterion.model_copy(update={"found": found, "expected": expected})

    def execute(tasks, setup):
        for task in tasks:
            grade = make_grade(task.id)
            criteria = tuple(judged(c, numbers[int(task.id[1:])]) for c in grade.criteria)
            grade = grade.model_copy(update={"criteria": criteria})
            yield make_outcome(grade, key=task.key, fingerprints=b"")

    flagged = []
    given = {(name, number.value) for (_, name), number in numbers[1].items()}
    for examples in ((), (Example(fingerprints=b"", numbers=frozenset(given)),)):
        out = tmp_path / f"out-{len(flagged)}"
        out.mkdir()
        with Gradebook(out, create=True) as book:
            batch = grade_batch(
                find_hand_ins([tmp_path / "in"], scratch=tmp_path),
                setup=Setup(rubric=rubric, scratch=tmp_path),
                book=book,
                execute=execute,
                examples=lambda examples=examples: examples,
            )
        flagged.append({name: flag.parameters for name, flag in batch.shared.items()})
    assert flagged == [{"t1": ("initial", "final"), "t3": ("initial", "final")}, {}]
