"""Answers made to fit Tables 4 and 5 of the paper reproduce these tables."""

import json
import re

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.publish.survey import LEVELS, SCALE, read_survey, survey_dict, survey_text

# Table 4 of Throne (2005) gives whole percentages of the twelve students who answered.
TABLE_4 = {
    "uses of models": (75, 25, 0, 0, 0),
    "limitations of models": (58, 33, 8, 0, 0),
    "frequency response": (42, 58, 0, 0, 0),
}
COUNTS = {question: [round(12 * p / 100) for p in row] for question, row in TABLE_4.items()}
# The averages in Table 5 have two decimals; each is a multiple of 1/12.
TABLE_5 = {
    "approaches to modeling": ("2.83", "2.75", "3.67", "3.67"),
    "model and real system": ("3.00", "2.92", "3.67", "3.58"),
    "prediction and response": ("2.75", "2.92", "3.75", "3.75"),
}


def answers(average: str) -> list[int]:
    """Return twelve scores with the given average."""
    total = round(12 * float(average))
    low, more = divmod(total, 12)
    return [low + (i < more) for i in range(12)]


def write_paper(path, *, heading="{level}: {concept}"):
    """Write the answers of the paper's class; twelve of the thirteen students answered."""
    columns: dict[str, list[str]] = {"Timestamp": [f"2003-11-{d:02d}" for d in range(1, 14)]}
    for question, counts in COUNTS.items():
        given = [word for word, n in zip(SCALE, counts, strict=True) for _ in range(n)]
        columns[question] = [*given, ""]
    for concept, averages in TABLE_5.items():
        for level, average in zip(LEVELS, averages, strict=True):
            scores = [f"{score} = so much" for score in answers(average)]
            columns[heading.format(level=level, concept=concept)] = ["", *scores]
    lines = [columns, *zip(*columns.values(), strict=True)]
    path.write_text("\n".join(",".join(line) for line in lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "heading", ["{level}: {concept}", "{level} [{concept}]", "{level} - {concept}"]
)
def test_the_tables_of_the_paper_are_reproduced(tmp_path, heading):
    """The paper's tables are reproduced to the digit; a column of dates is left out."""
    survey = read_survey(write_paper(tmp_path / "answers.csv", heading=heading))

    assert {q: tuple(row) for q, *row in survey.percents.itertuples()} == TABLE_4
    means = survey.means.map("{:.2f}".format)
    assert {concept: tuple(row) for concept, *row in means.itertuples()} == TABLE_5
    assert survey.left_out == ("Timestamp",)
    assert survey.students == 13
    plain = json.loads(json.dumps(survey_dict(survey)))
    assert plain["concepts"][0]["means"]["Pre Course Knowledge"] == 2.83
    assert plain["concepts"][0]["answers"]["Pre Course Knowledge"] == 12


def test_the_tables_are_printed_as_markdown(tmp_path):
    """The tables printed as Markdown have the paper's headings and aligned columns."""
    text = survey_text(read_survey(write_paper(tmp_path / "answers.csv")))
    rows = [re.split(r"\s*\|\s*", line.strip("| ")) for line in text.splitlines() if "|" in line]
    assert rows[0] == ["Question", *SCALE]
    assert rows[3] == ["limitations of models", "58 %", "33 %", "8 %", "0 %", "0 %"]
    assert rows[5] == ["Concept", *LEVELS]
    assert rows[7] == ["approaches to modeling", "2.83", "2.75", "3.67", "3.67"]
    assert "Table 4: " in text
    assert "Table 5: " in text


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("Q\nAgree\nAgree\nPerhaps\n", "4, 'Q': 'Perhaps'"),
        ("Pre knowledge: x\n3\n5\n", "x': '5'"),
        ("Pre knowledge: x\n3.5\n", "'3.5'"),
        ("Pre knowledge: x,pre-course Knowledge [x]\n3,4\n", "two columns"),
        ("name,age\nann,20\n", "no question"),
        ("Q\n", "one row"),
        ("", "one row"),
    ],
)
def test_answers_off_the_scale_are_an_error(tmp_path, rows, message):
    """An answer off the scale is an error that names line, question and answer."""
    path = tmp_path / "a.csv"
    path.write_text(rows, encoding="utf-8")
    with pytest.raises(ConfigError, match=re.escape(message)):
        read_survey(path)


def test_answers_may_be_written_in_many_ways(tmp_path):
    """Capitals and the kind of apostrophe do not matter in answers, and scores may be words."""
    path = tmp_path / "a.csv"
    text = (
        "Q;post_knowledge: x\nstrongly agree;Moderate\nI don’t know;4\nDon't know.;high, used it\n"
    )
    path.write_text(text, encoding="utf-8")
    survey = read_survey(path)
    assert survey.opinions.loc["Q"].tolist() == [1, 0, 0, 0, 2]
    assert survey.means.loc["x", "Post Course Knowledge"] == 3.67
    plain = json.loads(json.dumps(survey_dict(survey)))
    assert plain["concepts"][0]["means"]["Pre Course Knowledge"] is None
    assert "| x       |                    – |" in survey_text(survey)
