"""The check names the numbers that disagree and where to look, but reveals no value."""

import json
import re
from functools import cache

import pytest

from pipeline.grading.self_check.answers import CheckAnswer, answer_line, answer_lines
from pipeline.grading.self_check.check import JudgedNumbers, judge_numbers, next_answer
from tests.helpers.grading_class import Team, make_team
from tests.helpers.grading_slips import OF_SEVERAL_CARTS, SLIPS, reporting, scaled

# One bench each with one, two and three carts.
LONG = [pytest.mark.slow, pytest.mark.sample]
SEEDS = [0, *(pytest.param(seed, marks=LONG) for seed in (1, 2))]
NOT_PLACED = {  # seeds for which no number disagrees with the recordings
    "initial_final_disagree",
    "missing",
    "no_fit_done",
}
team = cache(make_team)


def slipped(slip: str, seed: int) -> Team:
    """Return the seed's team with a mistake, or unchanged if its carts do not allow the mistake."""
    one = team(seed)
    alone = one.bench.chain.n == 1 and slip in OF_SEVERAL_CARTS
    return one if alone else SLIPS[slip](one)


def judge(one: Team) -> JudgedNumbers:
    return judge_numbers(one.submission, one.analysis, rubric=one.rubric)


@cache
def judged(slip: str, seed: int) -> tuple[Team, JudgedNumbers]:
    """Return the seed's team with a mistake, and what the check finds."""
    one = slipped(slip, seed)
    return one, judge(one)


def asked_twice(found: JudgedNumbers) -> tuple[CheckAnswer, CheckAnswer]:
    first = next_answer(found, (), basis="0")
    return first, next_answer(found, (first,), basis="0")


def stripped(text: str, one: Team) -> str:
    """Return a text without counts and without the names of numbers, recordings and carts."""
    for run in sorted((e.id for e in one.submission.experiments), key=len, reverse=True):
        text = text.replace(run, "")
    text = re.sub(r"(initial|final)\.\w+|state_space\.[AB]\([\d, ]+\)", "", text)
    text = re.sub(r"^(\d+ of|All) \d+ numbers?|run \d+ times?", "", text, flags=re.MULTILINE)
    said = ("2π", "cart 1", "n − 1", "log10", "cartlab-check/1")  # the names of recordings
    return re.sub("|".join(said), "", text)


@pytest.mark.parametrize("slip", sorted(SLIPS))
@pytest.mark.parametrize("seed", SEEDS)
def test_no_answer_contains_digits_of_a_value(seed, slip):
    """In words and in JSON, the only digits of an answer are in names and counts."""
    one, found = judged(slip, seed)
    for answer in asked_twice(found):
        said = stripped("\n".join(answer_lines(answer)), one)
        assert re.findall(r".*\d.*", said) == []
        plain = json.loads(answer_line(answer))
        assert (plain.pop("ask"), plain.pop("basis")) == (answer.ask, "0")
        assert re.findall(r".{0,30}\d.{0,30}", stripped(json.dumps(plain), one)) == []


@pytest.mark.parametrize("seed", [0, 1])
def test_the_answer_reveals_neither_sign_nor_size_of_an_error(seed):
    """The answer does not reveal whether a gain is too large or too small, nor by how much."""
    one = team(seed)
    name = next(iter(one.reported.final))
    answers = set()
    for factor in (1.33, 1.55, 1 / 1.33):
        moved = scaled(one, [name], factor, ["final"])
        alone = moved.reported.model_copy(update={"feedback": None, "state_space": None})
        _, where = asked_twice(judge(reporting(moved, alone)))
        assert where.disagree == (f"final.{name}",)
        answers.add(answer_line(where))
    assert len(answers) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_honest_numbers_agree(seed):
    """For a careful student, at most one number disagrees, and the result is that all agree."""
    one = team(seed)
    found = judge(one)
    assert found.agree
    assert len(found.disagree) <= 1
    assert next_answer(found, (), basis="0").stage == "which"


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("slip", sorted(SLIPS.keys() - NOT_PLACED))
def test_most_common_mistakes_are_recognised(slip):
    """At the second run, the check names the right mistake for most of the wrong numbers."""
    placed = []
    for seed in range(3):
        one, found = judged(slip, seed)
        if one is team(seed) or not found.disagree:
            continue
        _, where = asked_twice(found)
        assert {hint.number for hint in where.hints} == set(found.disagree)
        placed.append(slip in {code for h in where.hints for code in (h.slip, *h.or_else)})
    assert placed
    assert sum(placed) >= 0.6 * len(placed)


def test_only_an_unchanged_number_gets_a_hint_where_to_look():
    """The first answer says which numbers disagree; the next one says where to look.

    After any change, the answer again says only which numbers disagree.
    """
    one = SLIPS["peak_to_peak"](team(1))
    found = judge(one)
    first, second = asked_twice(found)
    assert (first.stage, first.hints) == ("which", ())
    assert (second.stage, second.ask) == ("where", 2)
    changed = next_answer(found, (first, second), basis="1")
    assert (changed.stage, changed.ask, changed.hints) == ("which", 3, ())
    number = found.disagree[-1]
    of_one = next_answer(found, (first,), basis="0", where=[number])
    assert [hint.number for hint in of_one.hints] == [number]
    honest = next_answer(judge(team(1)), (first,), basis="0", where=["final.K_1"])
    assert honest.stage == "which"
