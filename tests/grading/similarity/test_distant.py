"""The class page names teams whose carts differ from those of the class."""

import re

import numpy as np
import pytest

from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.similarity.class_questions import find_distant, recomputed_numbers
from pipeline.setup import PAPER_UNITS
from tests.helpers.grades import book_of, make_grade, two_cart_rubric

RUBRIC = two_cart_rubric()
TRUE = {("K_1", "cm/V"): 24.3, ("omega_1", "rad/s"): 20.2, ("omega_2", "rad/s"): 32.9}


def carts(seed, *, spread=0.01, **factors):
    """Return the numbers of one team; `factors` change some of them."""
    rng = np.random.default_rng(seed)
    return {
        (name, unit): true * (1 + spread * rng.standard_normal()) * factors.get(name, 1)
        for (name, unit), true in TRUE.items()
    }


def distant(*class_):
    found = find_distant({f"t{number:02d}": own for number, own in enumerate(class_)})
    return {one.submission: [name for name, *_ in one.numbers] for one in found}


@pytest.mark.parametrize("n", [4, 5, 30])
@pytest.mark.parametrize("factor", [0.7, 1.25])
def test_a_team_with_other_springs_is_named(n, factor):
    """A number 25 % off is named from five teams on, whatever their spread below 10 %."""
    class_ = [carts(seed) for seed in range(n - 1)]
    found = distant(*class_, carts(99, omega_1=factor, K_1=factor**2))
    assert found == ({f"t{n - 1:02d}": ["K_1", "omega_1"]} if n >= 5 else {})


@pytest.mark.parametrize("spread", [0.0, 0.001, 0.03, 0.2])
def test_an_ordinary_class_has_no_note(spread):
    """The spread of the class itself decides: differences below 10 % or 10 MAD are usual."""
    off = 1.09 if spread < 0.01 else 1.0
    class_ = [carts(seed, spread=spread) for seed in range(100)]
    assert distant(*class_, carts(101, spread=spread, omega_1=off)) == {}


def test_a_class_on_two_benches_has_no_note():
    """If a third of the class has another bench, its teams are not unusual."""
    class_ = [carts(s, omega_1=1.3 if s % 3 == 0 else 1) for s in range(12)]
    assert distant(*class_) == {}


def test_other_units_are_not_compared():
    """A static gain in other units is no other cart; the frequencies are still compared."""
    own = carts(50, omega_2=1.5)
    own["K_1", "mm/V"] = 10 * own.pop(("K_1", "cm/V"))
    assert distant(*(carts(seed) for seed in range(9)), own) == {"t09": ["omega_2"]}


@pytest.mark.parametrize("anonymous", [False, True])
def test_the_class_page_asks_about_the_team(tmp_path, anonymous):
    """The page links the team and shows both numbers; points and flags do not change."""
    ids = {asked.id for asked in RUBRIC.criteria if asked.check == "final"}
    class_ = []
    for number in range(6):
        grade = make_grade(f"team-{number}", units=PAPER_UNITS)
        right = {"omega_1": 26.0 if number == 4 else 20.0 + 0.01 * number, "zeta_1": 10.0**number}
        criteria = tuple(
            one.model_copy(update={"expected": right if one.id in ids else {}})
            for one in grade.criteria
        )
        class_.append(grade.model_copy(update={"criteria": criteria}))
    rubric = RUBRIC.model_copy(update={"anonymous": anonymous})
    with book_of(tmp_path / "g.sqlite", *class_, rubric=rubric) as book:
        write_outputs(book, tmp_path)
        grades = [entry.grade for entry in book.entries()]
    html = (tmp_path / "class.html").read_text(encoding="utf-8")
    text = re.sub(r"<[^>]+>", "", html)
    said = re.search(r"\?\):\s*([\w-]+): omega_1 \D*26\.0\s+rad/s \(\D*20\.0\)", text)
    assert said
    assert said[1].startswith("anon-") if anonymous else said[1] == "team-4"
    assert not any(grade.flags for grade in grades)
    assert recomputed_numbers(grades[4], rubric=RUBRIC) == {("omega_1", "rad/s"): 26.0}
