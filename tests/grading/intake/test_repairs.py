"""A repaired `submission.toml` is graded in place of the text for which it was made."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.gradings import Grading, HandIn
from pipeline.grading.intake.repairs import (
    FOLDER,
    Repair,
    Run,
    forget_repairs,
    keep_original,
    read_original,
    read_repairs,
    read_run,
    save_repair,
    save_run,
    text_key,
)
from pipeline.grading.rubric_file import load_rubric
from pipeline.simulated.submission import write_submission

BY_ADA = {"by": "Ada", "why": "comma"}


def test_a_repair_counts_only_for_its_text(tmp_path):
    """A repair is graded for the text it was made for; the handed-in file stays as it is.

    For another text the repair is not used. A text with a mistake is returned, to be repaired.
    """
    folder, scratch = tmp_path / "team-07", tmp_path / "scratch"
    scratch.mkdir()
    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    toml = folder / "submission.toml"
    right = toml.read_text("utf-8")
    wrong = right.replace("carts = 1", "carts = 1,0").replace("\n", "\r\n")
    rubric = load_rubric(Path("throne-1dof"))

    def graded(text: str, **repairs: Repair) -> Grading:
        toml.write_bytes(text.encode())
        plain = {key: asdict(repair) for key, repair in repairs.items()}
        task = HandIn(id="team-07", key="k", sources=(folder,), repairs=plain)
        return grade_hand_in(task, rubric=rubric, scratch=scratch)

    failed = graded(wrong)
    assert (failed.status, failed.original) == ("failed", wrong)
    repairs = {text_key(wrong): Repair(text=right, **BY_ADA)}
    repaired = graded(wrong, **repairs)
    grade = json.loads(repaired.grade)
    assert (grade["points"], grade["repaired"]) == (20, "by Ada: comma")
    assert (repaired.original, toml.read_bytes().decode()) == (wrong, wrong)
    other = graded(right.replace("carts = 1", "carst = 1"), **repairs)
    assert other.status == "failed"
    plain = graded(right, **repairs)
    assert (json.loads(plain.grade)["repaired"], plain.original) == ("", "")
    assert graded(right.replace("K = ", "K = 1,", 1)).original != ""


def test_a_repair_is_saved_for_the_text_that_a_person_saw(tmp_path):
    """A repair is saved only for the text that is current, and with a reason."""
    keep_original(tmp_path, "team-07", "first\r\n")
    assert read_original(tmp_path, "team-07") == "first\r\n"
    repair, key = Repair(text="right", **BY_ADA), text_key("first\r\n")
    save_repair(tmp_path, "team-07", repair, of=key)
    assert read_repairs(tmp_path, "team-07") == {key: repair}
    with pytest.raises(ConfigError, match="a reason"):
        save_repair(tmp_path, "team-07", Repair(text="x", by="Ada", why=" "), of=key)
    keep_original(tmp_path, "team-07", "second")
    with pytest.raises(ConfigError, match="again"):
        save_repair(tmp_path, "team-07", repair, of=key)
    assert read_repairs(tmp_path, "team-07") == {key: repair}  # kept for the first text
    keep_original(tmp_path, "team-07", "")
    assert read_original(tmp_path, "team-07") is None


def test_an_erased_submission_is_no_path_of_the_last_grading_any_more(tmp_path):
    """The paths that name it are forgotten with it; a folder of the whole class stays."""
    paths = ("/lab/zebra.zip", "/lab/zebra", "/lab/zebra-2", "/lab")
    save_run(tmp_path, Run(paths=paths, rubric="lab.toml"))
    forget_repairs(tmp_path, ["mon-zebra", "mon/zebra"])
    assert read_run(tmp_path) == Run(paths=("/lab/zebra-2", "/lab"), rubric="lab.toml")


@pytest.mark.parametrize("spoilt", ["", "[]", '{"paths": []}', '{"paths": [1], "rubric": "r"}'])
def test_a_spoilt_note_of_the_last_grading_is_no_note(spoilt, tmp_path):
    """If the file about the last grading is damaged, nothing is known about that grading."""
    save_run(tmp_path, Run(paths=("/lab",), rubric="lab.toml"))
    (tmp_path / "run.json").write_text(spoilt, encoding="utf-8")
    assert read_run(tmp_path) is None
    (tmp_path / FOLDER / "team-07" / "k").mkdir(parents=True)
    (tmp_path / FOLDER / "team-07" / "k" / "repair.json").write_text(spoilt, encoding="utf-8")
    (tmp_path / FOLDER / "team-07" / "latest").write_bytes(b"\xff")
    assert read_repairs(tmp_path, "team-07") == {}
    assert read_original(tmp_path, "team-07") is None


def test_a_submission_with_the_name_of_a_file_of_the_class_blocks_nobody(tmp_path):
    """A student's folder may have any name."""
    keep_original(tmp_path, "run.json", "[submission")
    run = Run(paths=("/lab",), rubric="lab.toml")
    save_run(tmp_path, run)
    assert read_run(tmp_path) == run
    assert read_original(tmp_path, "run.json") == "[submission"
