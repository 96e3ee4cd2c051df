"""With an answer key, a team is judged by the true values of its own bench."""

import json
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import answer_key as copying
from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.gradings import HandIn
from pipeline.grading.judge.checks import judge
from pipeline.grading.judge.run import Graded, grade_submission, prepare_work
from pipeline.grading.mistakes.table_flags import off_flag
from pipeline.grading.reference import TRUE, Reference, References, recompute
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.true_bench import TrueBench, with_benches
from pipeline.json_files import json_text
from pipeline.plant.catalogue import find_effect
from pipeline.plant.effect import EffectTerm
from pipeline.resources import RUBRICS
from pipeline.simulated.answer_key import AnswerKey, TeamBench, bench_of_team, draw_bench
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.commandline import cartlab_here

RUBRIC = load_rubric(RUBRICS / "throne-1dof.toml")


def draw(seed: int, *hide: str):
    bench = prepare_bench(preset="throne-1dof", hide=hide)
    return draw_bench(bench, percent=20, rng=np.random.default_rng(seed))


def measured(values: dict[str, float]) -> References:
    of = {name: Reference.at(value, source="bode_fit") for name, value in values.items()}
    return References(initial=of, final=of)


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """A submission from a bench with dry friction, and the bench as its answer key has it."""
    folder = tmp_path_factory.mktemp("friction")
    own, answers = draw(1, "coulomb_friction:cart=1,force=0.003")
    write_submission(folder, own, seed=3, reported=True, compact=True)
    submission = load_submission(folder)
    found = {n: r.value for n, r in recompute(analyse(submission, design=False)).final.items()}
    return submission, replace(answers, found=found)


def grade(submission, bench: TeamBench | None) -> Graded:
    text = json_text(bench) if bench else ""
    return grade_submission(submission, rubric=RUBRIC, name="a", bench=text)


def test_an_honest_team_keeps_its_points(friction):
    """With friction too, true values cost an honest team nothing."""
    submission, bench = friction
    without, with_key = grade(submission, None).grade, grade(submission, bench).grade
    assert with_key.points >= without.points
    assert set(with_key.codes) <= set(without.codes)
    final = next(one for one in with_key.criteria if "K" in one.expected and "final" in one.id)
    assert final.expected["K"] == pytest.approx(bench.parameters["K"])


@pytest.mark.slow
@pytest.mark.sample
def test_recordings_of_another_bench_do_not_count(friction):
    """Recordings and numbers of a neighbour count as not handed in, and are wrong."""
    submission, own = friction
    neighbour = draw(2)[1]
    judged = grade(submission, neighbour).grade
    assert {"data_problem", "missing"} <= set(judged.codes)
    outcomes = {one.id: one.outcome for one in judged.criteria}
    assert outcomes["data"] == outcomes["dwells"] == outcomes["hardware"] == "fail"
    assert judged.points < 0.6 * grade(submission, own).grade.points


def test_true_values_are_in_the_units_of_the_submission():
    """Gains, masses and springs follow the submission's own units; frequencies stay."""
    _, answers = draw(1)
    text = json_text(answers)
    usual = TrueBench.read(text, RUBRIC.system)
    position = RUBRIC.system.position.model_copy(update={"unit": "mm"})
    other = TrueBench.read(text, RUBRIC.system.model_copy(update={"position": position}))
    assert other.parameters["K"] == pytest.approx(10 * usual.parameters["K"])
    assert other.parameters["omega_n"] == usual.parameters["omega_n"]
    assert other.chain.parameters() == pytest.approx(dict(other.parameters))


def test_hidden_effects_are_in_the_units_of_the_submission():
    """Sizes follow the units of length and input, whatever their powers."""
    _, answers = draw(1, "coulomb_friction", "cubic_spring", "input_delay")
    position = RUBRIC.system.position.model_copy(update={"unit": "mm"})
    system = RUBRIC.system.model_copy(update={"position": position})
    system = system.model_copy(update={"input": system.input.model_copy(update={"unit": "mV"})})
    usual, other = (TrueBench.read(json_text(answers), one) for one in (RUBRIC.system, system))
    assert usual.effects
    assert other.effects
    ratios = [b.values[0] / a.values[0] for a, b in zip(usual.effects, other.effects, strict=True)]
    assert ratios == pytest.approx([1e3, 1e3 / 10**3, 1.0])  # V, V/cm³ and s


def test_bounds_are_those_of_the_own_bench():
    """Own recordings widen the bounds around the true value; those of others do not."""
    _, answers = draw(1)
    true = TrueBench.read(json_text(answers), RUBRIC.system)
    K, omega = true.parameters["K"], true.parameters["omega_n"]
    own = measured({"K": 1.01 * K, "omega_n": 0.99 * omega})
    others = measured({"K": 1.2 * K, "omega_n": 1.1 * omega})
    assert true.shows_in(own)
    assert not true.shows_in(others)
    assert not true.shows_in(measured({"K": K, "omega_n": 1.1 * omega}))  # half agree by chance
    judged = true.references(own, is_own=True).final["K"]
    assert (judged.value, judged.high, judged.source) == (K, 1.01 * K, TRUE)
    judged = true.references(others, is_own=False).final["K"]
    assert (judged.low, judged.high) == (K, K)
    typed = {"K": Decimal("3.00")}
    flags = [
        off_flag(typed, ["K"], {"K": Reference.at(K, source=source)}, "final")
        for source in (TRUE, "bode_fit")
    ]
    assert flags[0].evidence["recomputed"] == flags[1].evidence["recomputed"]
    assert flags[0].message != flags[1].message  # it says what the number is compared with


def test_a_bench_belongs_to_the_name_of_a_submission(tmp_path):
    """Case does not matter. A team that the key lacks is judged by its recordings."""
    key = AnswerKey(secret="0", teams={"Team-1": draw(1)[1]})
    (tmp_path / "key.json").write_text(json_text(key), "utf-8")
    found, lacking = with_benches([HandIn(id="team-1"), HandIn(id="x")], tmp_path / "key.json")
    assert [bool(one.bench) for one in found] == [True, False]
    assert lacking == ("x",)


@pytest.mark.slow
@pytest.mark.sample
def test_the_command_judges_by_the_key_and_names_who_is_missing(tmp_path):
    """`simulate` writes the key, `grade --key` uses it, and a later grading knows its path."""
    key, school = tmp_path / "key.json", tmp_path / "class"
    made = cartlab_here(
        "simulate", "--preset", "throne-1dof", "--vary", "20", "--secret", str(key),
        "--out", str(school / "a"), "--reported",
    )  # fmt: skip
    assert made.returncode == 0
    assert json.loads(key.read_text("utf-8"))["teams"]["a"]["found"]["omega_n"] > 0
    (school / "a").rename(school / "b")
    out = tmp_path / "grades"
    command = ("grade", str(school), "--rubric", "throne-1dof", "--out", str(out), "--no-figures")
    done = cartlab_here(*command, "--key", str(key))
    assert done.returncode == 0
    assert "answer key" in done.stderr
    assert json.loads((out / "run.json").read_text("utf-8"))["options"]["key"] == str(key)
    assert cartlab_here(*command, "--key", str(out / "class.html")).returncode == 2


@pytest.mark.slow
def test_copiers_lose_points_and_honest_teams_do_not(tmp_path):
    """Six teams in one run; the benchmark does the same with 120."""
    kinds = copying.summarise(list(copying.points_of_class(tmp_path, teams=6)))
    assert kinds["honest"].min() >= 19.5
    assert kinds["numbers copied"][:, 1].max() <= 18
    assert kinds["all copied"].max() <= 10


NAMED = asked.Effects(id="effects", check="effects", points=4)
FRICTION = {"coulomb_friction": {"cart": 1, "force": Decimal("0.0031")}}


@pytest.mark.parametrize(
    ("effects", "share"),
    [
        (FRICTION, 1),
        ({"coulomb_friction": {"cart": 1, "force": Decimal("0.0060")}}, Fraction(2, 3)),
        ({"coulomb_friction": {"cart": 2, "force": Decimal("0.0031")}}, Fraction(2, 3)),
        ({"coulomb_friction": {"cart": 1}}, Fraction(2, 3)),
        ({"coulomb_friction": {"force": Decimal("0.0031")}}, Fraction(2, 3)),
        (FRICTION | {"input_delay": {"delay": Decimal("0.01")}}, Fraction(3, 4)),
        ({"input_delay": {"delay": Decimal("0.01")}}, 0),
        ({}, 0),
        (None, 0),
    ],
)
def test_named_effects_are_judged_by_the_key(effects, share):
    """Name, place and each size count equally; an effect that is not there counts as a mistake."""
    reported = SimpleNamespace(effects=effects)
    context: Any = SimpleNamespace(
        effects=[known(0.0031)], reported=reported, because_unread=lambda *_: ""
    )
    verdict = judge(NAMED, context)
    assert verdict.share == share
    assert set(verdict.expected) == ({"coulomb_friction"} if effects is not None else set())


def test_the_key_knows_the_effects_of_a_bench(friction):
    """Effects that the student names are judged by those of the bench in the answer key."""
    submission, bench = friction
    bench = replace(bench, model=replace(bench.model, terms=[known(0.0031)]))
    reported = submission.reported.model_copy(update={"effects": FRICTION})
    submission = submission.model_copy(update={"reported": reported})
    analysis = analyse(submission, design=False)
    work = prepare_work(submission, analysis, rubric=RUBRIC, bench=json_text(bench))[0]
    assert judge(NAMED, work).share == 1


def test_without_a_key_nobody_judges_named_effects(friction):
    """An effect is not checked if nobody knows the bench."""
    work = prepare_work(friction[0], analyse(friction[0], design=False), rubric=RUBRIC)[0]
    assert judge(NAMED, work).share is None


def known(force: float) -> EffectTerm:
    return EffectTerm(effect=find_effect("coulomb_friction"), place=1, values=(force,))


@pytest.mark.parametrize(
    ("stated", "name"),
    [
        ("coulomb = { cart = 1 }", "coulomb"),
        ("coulomb_friction = { cart = 2 }", "coulomb_friction"),
        ("coulomb_friction = { size = 2 }", "coulomb_friction"),
    ],
)
def test_an_effect_that_cannot_be_read_costs_itself(tmp_path, stated, name):
    """An unknown effect, place or parameter counts as not reported; the rest stays."""
    text = "version = 1\nsystem.carts = 1\nsystem.input.unit = 'V'\nsystem.position.unit = 'cm'\n"
    text += f"[reported.effects]\n{stated}\ninput_delay = {{ delay = 0.01 }}\n"
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    submission = load_submission(tmp_path)
    assert [one.at for one in submission.unread] == [("reported", "effects", name)]
    assert submission.reported
    assert submission.reported.effects
    assert submission.reported.effects["input_delay"] == {"delay": Decimal("0.01")}


def test_a_virtual_bench_is_that_of_the_team(tmp_path):
    """The emulator gets the team's carts and effects; another number of carts is refused."""
    own = draw(1, "input_delay")[1]
    key = tmp_path / "key.json"
    key.write_text(json_text(AnswerKey(secret="0", teams={"a": own})), encoding="utf-8")
    bench = bench_of_team(prepare_bench(preset="throne-1dof"), team="a", key=key)
    assert json_text(bench.chain) == json_text(own.model.chain)
    assert [term.effect.key for term in bench.effects] == ["input_delay"]
    for preset, team in (("throne-2dof", "a"), ("throne-1dof", "b")):
        with pytest.raises(ConfigError):
            bench_of_team(prepare_bench(preset=preset), team=team, key=key)
