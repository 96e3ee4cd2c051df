"""Whether a report is up to date, wherever it was made."""

from pipeline.desk.last_report import NOTES, find_state
from pipeline.submission.load import NAME
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import a_submission


def test_a_report_of_the_command_line_is_current_at_the_desk(tmp_path):
    """The desk shows a report that `cartlab report` made as up to date until a source changes."""
    folder = a_submission(tmp_path / "team")
    assert find_state(folder) == "none"
    assert cartlab_here("report", folder).returncode in (0, 1)
    assert find_state(folder) == "current"
    (folder / NOTES).write_text("new words", encoding="utf-8")
    assert find_state(folder) == "answered"
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write("# a comment\n")
    assert find_state(folder) == "older"
