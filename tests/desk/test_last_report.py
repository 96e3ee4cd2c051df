"""Whether a report is up to date, wherever it was made."""

import pytest

from pipeline.desk.last_report import NOTES, PDF, find_state
from pipeline.desk.student.files import list_held
from pipeline.desk.tasks import make_report
from pipeline.submission.load import NAME
from pipeline.words.progress import silent
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import a_submission


@pytest.mark.parametrize("options", [[], ["--no-pdf"], ["--out", "team/report"]])
def test_a_report_of_the_command_line_is_current_at_the_desk(options, tmp_path, monkeypatch):
    """The desk shows a report that `cartlab report` made as up to date until a source changes."""
    monkeypatch.chdir(tmp_path)
    folder = a_submission(tmp_path / "team")
    assert find_state(folder) == "none"
    assert cartlab_here("report", folder, *options).returncode in (0, 1)
    assert find_state(folder) == "current"
    (folder / NOTES).write_text("new words", encoding="utf-8")
    assert find_state(folder) == "answered"
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write("# a comment\n")
    assert find_state(folder) == "older"


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("face", ["desk", "command line"])
def test_the_faces_replace_each_others_reports(face, tmp_path):
    """A report is up to date if it is newer than its sources, whichever face made the last one."""
    folder = a_submission(tmp_path / "team")
    make = {
        "desk": lambda: make_report(str(folder), progress=silent),
        "command line": lambda: cartlab_here("report", folder, "--no-pdf"),
    }
    make["command line" if face == "desk" else "desk"]()
    with (folder / NAME).open("a", encoding="utf-8") as file:
        file.write("# a comment\n")
    assert find_state(folder) == "older"
    make[face]()
    assert find_state(folder) == "current"
    # Only a report with a PDF can be handed in.
    assert (PDF in list_held(folder)) == (face == "desk")
