"""A damaged or hostile table gives either a result or one clear error."""

import csv
import io
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.errors import ConfigError
from pipeline.grading.intake.find import read_late_table
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.roster import Roster, Student
from pipeline.grading.publish.survey import read_survey, survey_dict, survey_text
from pipeline.grading.publish.view import new_view
from tests.helpers.grades import make_grade, two_cart_rubric

HEADS = ("Student", "ID", "SIS User ID", "Identifier", "ID number", "SID", "Email", "Lab 3 (7)",
         "Submission ID", "submission", "days_late", "Status", "Lateness (H:M:S)", "Q", "",
         "Pre knowledge: x", "post course Confidence [y]")  # fmt: skip
CELLS = ("1024", "Participant 7", "s1", "=cmd", "a;=cmd", "x\ry", "    Points Possible", "3", "4.0",
         "Agree", "I don't know", "1,5", "26:00:00", "Submitted - 1 day late", "\x00", "é", "nan",
         "ï¼1", "1" * 400, "¹")  # fmt: skip
_CELL = st.sampled_from(CELLS) | st.text(max_size=5)
_TABLE = st.integers(1, 6).flatmap(
    lambda n: st.tuples(
        st.lists(st.sampled_from(HEADS), min_size=n, max_size=n),
        st.lists(st.lists(_CELL, max_size=n + 1), max_size=5),
    )
)
STUDENTS = [
    Student(
        id=id_,
        name=name,
        number=number,
        view=new_view(make_grade(name, share=0.5), two_cart_rubric()),
    )
    for id_, name, number in (("s1", "a", ""), ("", "=cmd", "1024"), ("S1", "b", "7"))
]


def filled(platform) -> Callable[[Path], object]:
    """Return a function that fills in a platform's roster and checks the result."""

    def fill(path: Path) -> None:
        roster = Roster.read(path, platform=PLATFORMS[platform])
        text, _ = roster.fill(STUDENTS, {"Lab 3": lambda s: s.points}, possible="20")
        rows = list(csv.reader(io.StringIO(text, newline="")))
        assert len(rows) == len(roster.table) + 1 == text.count("\n")
        assert {len(row) for row in rows} == {len(rows[0])}

    return fill


def tabulate(path: Path) -> None:
    """Read a questionnaire and write the tables of its answers."""
    survey = read_survey(path)
    survey_text(survey)
    survey_dict(survey)


READERS = {
    "canvas": filled("canvas"),
    "moodle": filled("moodle"),
    "gradescope": filled("gradescope"),
    "lateness": read_late_table,
    "survey": tabulate,
}


@pytest.mark.parametrize("reader", READERS)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(table=_TABLE, separator=st.sampled_from(",;\t"), tail=st.binary(max_size=4))
def test_a_hostile_table_is_read_or_refused(tmp_path, reader, table, separator, tail):
    """Whatever its content, a table is read or refused with one clear line."""
    head, rows = table
    buffer = io.StringIO(newline="")
    csv.writer(buffer, delimiter=separator, escapechar="\\").writerows([head, *rows])
    path = tmp_path / "t.csv"
    path.write_bytes(buffer.getvalue().encode("utf-8", "surrogatepass") + tail)
    try:
        READERS[reader](path)
    except ConfigError as error:
        said = str(error)
    else:
        said = "t.csv"
    assert "t.csv" in said
    assert len(said) < 2_000
