"""The demonstration's second process: it does not outlive the first, and hides no failure."""

import pytest

from pipeline.cli.demo import found_beside, search_beside
from pipeline.errors import SubmissionError


def test_what_the_other_process_could_not_do_is_said_by_this_one(tmp_path):
    """A bench of an earlier run that somebody spoilt is named, as the command alone would."""
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "submission.toml").write_text("version = 1\n", encoding="utf-8")

    with search_beside(tmp_path) as beside, pytest.raises(SubmissionError, match="system"):
        found_beside(beside, tmp_path)

    assert beside.returncode == 1


def test_an_interrupted_demonstration_leaves_no_process_behind(tmp_path):
    """The search would take ten seconds: it is ended before it has written anything."""
    with pytest.raises(KeyboardInterrupt), search_beside(tmp_path) as beside:
        raise KeyboardInterrupt
    assert beside.returncode
    assert not (tmp_path / "gap").exists()
