"""What students say of the course: the paper's Tables 4 and 5 from a questionnaire's answers.

A row of the CSV is one student, a column one question. A column is an opinion where its answers
are on the scale of Table 4; it is about a concept (Table 5) where its heading says when and what:
`Pre knowledge: Bode plots`, `Post-course confidence [Bode plots]`. Others are left out.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_UP, Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError
from pipeline.grading.table import read_table

SCALE = ("Strongly Agree", "Agree", "Disagree", "Strongly Disagree", "I Don't Know")
LEVELS = ("Pre Course Knowledge", "Pre Course Confidence",
          "Post Course Knowledge", "Post Course Confidence")  # fmt: skip
_AGREEMENT = {
    "strongly agree": 0, "agree": 1, "disagree": 2, "strongly disagree": 3,
    "i dont know": 4, "dont know": 4, "no opinion": 4,
}  # fmt: skip
_WORDS = {"no clue": 1, "low": 2, "moderate": 3, "high": 4}
_CONCEPT = re.compile(
    r"(?P<when>pre|post)[\s_-]*(?:course)?[\s_-]*(?P<what>knowledge|confidence)"
    r"\s*(?:[:\-–—]\s*(?P<plain>.+)|\[(?P<boxed>.+)\])",
    re.IGNORECASE | re.DOTALL,
)


@dataclass(frozen=True, kw_only=True)
class Opinion:
    """A row of Table 4: how many answered what, in the order of `SCALE`."""

    question: str
    counts: tuple[int, ...]

    @property
    def percents(self) -> tuple[int, ...]:
        """Whole percents of those who answered, halves up, as the paper has them."""
        total = sum(self.counts)
        return tuple((200 * n + total) // (2 * total) for n in self.counts)


@dataclass(frozen=True, kw_only=True)
class Concept:
    """A row of Table 5: the answers (1 to 4) by the headings of `LEVELS`."""

    concept: str
    answers: Mapping[str, tuple[int, ...]]

    def mean(self, level: str) -> str:
        """Return the average score with two decimals, "" where nobody answered."""
        given = self.answers.get(level, ())
        if not given:
            return ""
        exact = Fraction(sum(given), len(given))
        average = Decimal(exact.numerator) / Decimal(exact.denominator)
        return str(average.quantize(Decimal("0.01"), ROUND_HALF_UP))


@dataclass(frozen=True, kw_only=True)
class Survey:
    """The answers of a questionnaire.

    Attributes
    ----------
    students : rows of the table.
    left_out : headings of columns that are no question of either table.
    """

    students: int
    opinions: tuple[Opinion, ...]
    concepts: tuple[Concept, ...]
    left_out: tuple[str, ...]


def read_survey(path: Path) -> Survey:
    """Read the answers; commas, semicolons or tabs.

    Raises
    ------
    ConfigError : not a table, no question in it, or an answer that is not on the scale.
    """
    rows = read_table(path)
    if len(rows) < 2:
        raise ConfigError(f"{path.name}: needs a heading and at least one row of answers")
    head, answers = [text.strip() for text in rows[0][1]], rows[1:]
    opinions, left_out = [], []
    concepts: dict[str, dict[str, tuple[int, ...]]] = {}
    for column, title in enumerate(head):
        given = [
            (line, row[column].strip())
            for line, row in answers
            if column < len(row) and row[column].strip()
        ]
        if found := _CONCEPT.fullmatch(title):
            concept = " ".join((found["plain"] or found["boxed"]).split())
            level = f"{found['when']} Course {found['what']}".title()
            scores = tuple(_score(text, path.name, line, title) for line, text in given)
            if level in concepts.setdefault(concept, {}):
                raise ConfigError(f"{path.name}: two columns are {title!r}")
            concepts[concept][level] = scores
        elif given and sum(_agreement(text) is not None for _, text in given) * 2 > len(given):
            opinions.append(_opinion(title, given, path.name))
        elif title:
            left_out.append(title)
    if not opinions and not concepts:
        raise ConfigError(
            f"{path.name}: no question in it: answers from {SCALE[0]!r} to {SCALE[-1]!r}, or "
            "headings such as 'Pre knowledge: Bode plots' with scores from 1 to 4"
        )
    return Survey(
        students=len(answers),
        opinions=tuple(opinions),
        concepts=tuple(Concept(concept=c, answers=levels) for c, levels in concepts.items()),
        left_out=tuple(left_out),
    )


def _agreement(text: str) -> int | None:
    plain = re.sub(r"[^a-z ]", "", text.casefold().replace("’", "'").replace("'", ""))
    return _AGREEMENT.get(" ".join(plain.split()))


def _opinion(question: str, given: Sequence[tuple[int, str]], file: str) -> Opinion:
    counts = [0] * len(SCALE)
    for line, text in given:
        at = _agreement(text)
        if at is None:
            raise ConfigError(
                f"{file} line {line}, {question!r}: {text!r} is not one of {', '.join(SCALE)}"
            )
        counts[at] += 1
    return Opinion(question=question, counts=tuple(counts))


def _score(text: str, file: str, line: int, question: str) -> int:
    """Return a score: "3", "3 = Moderate", "3.0" or "Moderate, …"."""
    number = re.match(r"([1-4])(?:\.0+)?(?![\d.,])", text)
    word = next((score for word, score in _WORDS.items() if text.casefold().startswith(word)), None)
    score = int(number[1]) if number else word
    if score is None:
        raise ConfigError(f"{file} line {line}, {question!r}: {text!r} is no score from 1 to 4")
    return score


# ---------------------------------------------------------------------------- output


def survey_dict(survey: Survey) -> dict[str, Any]:
    """Return both tables as plain data, with the counts behind them."""
    return {
        "schema": "cartlab-survey/1",
        "students": survey.students,
        "opinions": [
            {
                "question": o.question,
                "counts": dict(zip(SCALE, o.counts, strict=True)),
                "percents": dict(zip(SCALE, o.percents, strict=True)),
            }
            for o in survey.opinions
        ],
        "concepts": [
            {
                "concept": c.concept,
                "means": {level: float(m) if (m := c.mean(level)) else None for level in LEVELS},
                "answers": {level: len(c.answers.get(level, ())) for level in LEVELS},
            }
            for c in survey.concepts
        ],
        "left_out": list(survey.left_out),
    }


def survey_text(survey: Survey) -> str:
    """Return both tables as Markdown, which reads as it is."""
    parts = []
    if survey.opinions:
        rows = [[o.question, *(f"{p} %" for p in o.percents)] for o in survey.opinions]
        parts.append(_markdown(["Question", *SCALE], rows))
        parts.append("Table 4: Results of student questionnaires at end of the course.")
    if survey.concepts:
        rows = [[c.concept, *(c.mean(level) or "–" for level in LEVELS)] for c in survey.concepts]
        parts.append(_markdown(["Concept", *LEVELS], rows))
        parts.append("Table 5: Pre and post course knowledge and confidence (average score).")
    return "\n\n".join(parts)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    lines = [
        "| "
        + " | ".join(
            text.ljust(width) if i == 0 else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        + " |"
        for row in cells
    ]
    rule = "|".join(
        ("-" * (width + 2)) if i == 0 else f"{'-' * (width + 1)}:" for i, width in enumerate(widths)
    )
    return "\n".join([lines[0], f"|{rule}|", *lines[1:]])
