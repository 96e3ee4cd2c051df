"""Days late are computed from the deadline or read from a table."""

from datetime import datetime

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.intake.find import HandIn, read_late_table, settle_lateness
from pipeline.grading.rubric import Late

DUE = datetime.fromisoformat("2026-11-20T23:59:00-08:00")


def hand_in(name: str, **fields) -> HandIn:
    return HandIn(id=name, sources=(), **fields)


def settle(tmp_path, *hand_ins: HandIn, text: str | None = None, due: datetime | None = None):
    """Return the days late by id, and the warnings."""
    table = {}
    if text is not None:
        path = tmp_path / "late.csv"
        path.write_text(text, encoding="utf-8")
        table = read_late_table(path)
    settled, remarks = settle_lateness(hand_ins, late=Late(due=due), table=table)
    return {one.id: one.days_late for one in settled}, remarks


def test_a_known_time_of_submission_is_compared_with_the_deadline(tmp_path):
    """If the time of submission is known, lateness is computed from the deadline.

    Any time zone is accepted. If the time is unknown, the platform's late mark counts.
    """
    days, _ = settle(
        tmp_path,
        hand_in("late", handed_in="2026-11-21T19:59:00+00:00"),
        hand_in("early", handed_in="2026-11-20T23:58:59-08:00"),
        hand_in("marked", days_late=1.0),
        due=DUE,
    )
    assert days == {"late": 0.5, "early": 0.0, "marked": 1.0}


def test_a_table_of_days_late_overrides_the_deadline(tmp_path):
    """The instructor's table of days late overrides the deadline.

    Zero days in the table mean an extension, and an unknown name gives a warning.
    """
    days, remarks = settle(
        tmp_path,
        hand_in("Team-01", days_late=1.0),
        hand_in("team-02", handed_in="2026-11-23T00:00:00+00:00"),
        hand_in("team-03", days_late=1.0),
        text="submission;days_late\nteam-01;0\nteam-02;1,5\nteam-99;2\n",
        due=DUE,
    )
    assert days == {"Team-01": 0.0, "team-02": 1.5, "team-03": 1.0}
    assert remarks == ["team-99"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "late.csv: "),
        ("submission,days_late\nx,soon\n", "line 2: days_late: "),
        ("submission,days_late\nx,-1\n", "line 2"),
        ("submission,days_late\nx,1\ny,2\nX,2\n", "line 4: 2"),
        ("submission,days_late\nx,nan\n", "line 2"),
    ],
)
def test_an_unreadable_table_of_days_late_is_an_error(tmp_path, text, message):
    """If the table of days late cannot be read, the error names the line."""
    with pytest.raises(ConfigError) as error:
        settle(tmp_path, hand_in("x"), text=text)
    assert message in str(error.value)
