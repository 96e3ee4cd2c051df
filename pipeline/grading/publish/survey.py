"""Make Tables 4 and 5 of Throne's paper from the answers to a questionnaire.

Each row of the CSV is one student, and each column is one question. A column is an opinion (Table
4) if all answers are on the scale of that table. A column is about a concept (Table 5) if its
heading says when and what was asked: `Pre knowledge: Bode plots`, `Post-course confidence [Bode
plots]`. Other columns are left out.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.submission.toml import quote
from pipeline.words.numbers import NOTHING

if TYPE_CHECKING:
    import pandas as pd

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """The answers to a questionnaire.

    Attributes
    ----------
    opinions : Table 4: for each question, how many students gave each answer of `SCALE`.
    means : Table 5: for each concept, the mean scores (1 to 4) for each of `LEVELS`, rounded to two
        decimals, halves up; NaN if nobody answered.
    answers : number of answers in each mean.
    left_out : headings of columns that belong to neither table.
    """

    students: int
    opinions: "pd.DataFrame"
    means: "pd.DataFrame"
    answers: "pd.DataFrame"
    left_out: tuple[str, ...]

    @property
    def percents(self) -> "pd.DataFrame":
        """Table 4 in whole percent of those who answered, halves rounded up, as in the paper."""
        total = self.opinions.sum(axis="columns")
        return (200 * self.opinions).add(total, axis="index").floordiv(2 * total, axis="index")


def read_survey(path: Path) -> Survey:
    """Read the answers from a CSV with commas, semicolons or tabs.

    Raises
    ------
    ConfigError : the file is not a table, has no question, or has an answer that is not on its
        scale.
    """
    import pandas as pd

    table = read_table(path)
    if table.empty:
        raise ConfigError(f"{path.name}: needs a heading and at least one row of answers")
    left_out, opinions = [], []
    concepts: dict[str, dict[str, pd.Series]] = {}
    for title, cells in table.items():
        title, cells = str(title), cells.str.strip()
        where, given = (path.name, title), cells[cells != ""]
        if found := _CONCEPT.fullmatch(title):
            concept = " ".join((found["plain"] or found["boxed"]).split())
            level = f"{found['when']} Course {found['what']}".title()
            if level in concepts.setdefault(concept, {}):
                raise ConfigError(f"{path.name}: two columns are {quote(title)}")
            concepts[concept][level] = _read(given, _score, "no score from 1 to 4", where)
        elif 2 * given.map(_agreement).count() > len(given):
            answers = _read(given, _agreement, f"not one of {', '.join(SCALE)}", where)
            counts = answers.value_counts().reindex(range(len(SCALE)), fill_value=0)
            opinions.append(counts.set_axis(SCALE).rename(title))
        elif title:
            left_out.append(title)
    if not opinions and not concepts:
        raise ConfigError(
            f"{path.name}: contains no question: expected answers from {SCALE[0]!r} to "
            f"{SCALE[-1]!r}, or "
            "headings such as 'Pre knowledge: Bode plots' with scores from 1 to 4"
        )

    def of_concepts(value: Callable[[pd.Series], float]) -> pd.DataFrame:
        rows = {c: {level: value(s) for level, s in of.items()} for c, of in concepts.items()}
        return pd.DataFrame.from_dict(rows, orient="index", columns=[*LEVELS], dtype=float)

    return Survey(
        students=len(table),
        opinions=pd.DataFrame(opinions, columns=[*SCALE]),
        means=of_concepts(_average),
        answers=of_concepts(len).fillna(0).astype(int),
        left_out=tuple(left_out),
    )


def _read(
    given: "pd.Series", read: Callable[[str], int | None], wanted: str, where: tuple[str, str]
) -> "pd.Series":
    """Return answers as numbers.

    Parameters
    ----------
    given : the answers as text; the index is the line of the file.
    wanted : end of the message about an answer that cannot be read.
    where : names of the file and of the question.
    """
    answers = given.map(read)
    for line, text in given.loc[answers.isna()].items():
        raise ConfigError(f"{where[0]} line {line}, {quote(where[1])}: {quote(text)} is {wanted}")
    return answers.astype(int)


def _average(scores: "pd.Series") -> float:
    # In whole numbers, 2.125 is rounded up to 2.13; as a float it might be rounded down.
    return int(200 * scores.sum() + len(scores)) // (2 * len(scores)) / 100 if len(scores) else nan


def _agreement(text: str) -> int | None:
    plain = re.sub(r"[^a-z ]", "", text.casefold().replace("’", "'").replace("'", ""))
    return _AGREEMENT.get(" ".join(plain.split()))


def _score(text: str) -> int | None:
    """Return a score: "3", "3 = Moderate", "3.0" or "Moderate, …"."""
    if number := re.match(r"([1-4])(?:\.0+)?(?![\d.,])", text):
        return int(number[1])
    return next((score for word, score in _WORDS.items() if text.casefold().startswith(word)), None)


# ---------------------------------------------------------------------------- output


def survey_dict(survey: Survey) -> dict[str, Any]:
    """Return both tables as a dictionary for JSON, with the counts from which they are computed."""
    return {
        "schema": "cartlab-survey/1",
        "students": survey.students,
        "opinions": [
            {"question": question, "counts": counts, "percents": percents}
            for question, counts, percents in zip(
                survey.opinions.index,
                survey.opinions.to_dict("records"),
                survey.percents.to_dict("records"),
                strict=True,
            )
        ],
        "concepts": [
            {"concept": concept, "means": means, "answers": survey.answers.loc[concept].to_dict()}
            for concept, means in survey.means.astype(object)
            .where(survey.means.notna(), None)
            .to_dict("index")
            .items()
        ],
        "left_out": list(survey.left_out),
    }


def survey_text(survey: Survey) -> str:
    """Return both tables as Markdown, which is also readable as plain text."""
    parts = []
    if len(survey.opinions):
        rows = [[str(q), *(f"{p} %" for p in row)] for q, *row in survey.percents.itertuples()]
        parts.append(_markdown(["Question", *SCALE], rows))
        parts.append("Table 4: Results of student questionnaires at the end of the course.")
    if len(survey.means):
        shown = survey.means.map(lambda mean: NOTHING if isnan(mean) else f"{mean:.2f}")
        rows = [[str(text) for text in row] for row in shown.itertuples()]
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
