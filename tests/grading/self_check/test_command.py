"""`cartlab check` is run as typed; its exit status and its file of answers are tested."""

import json
import re
import sys

import jsonschema
import pytest

from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.grade import read_grade
from pipeline.grading.gradings import HandIn
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.self_check.answers import FILE, read_answers
from pipeline.resources import RUBRICS
from tests.helpers.commandline import Done, cartlab_here
from tests.helpers.desks import a_submission
from tests.helpers.places import ROOT
from tests.helpers.spoilt import change

RUBRIC = RUBRICS / "throne-1dof.toml"


def refused(folder, *more) -> str:
    """Return why the check is refused, in one line."""
    done = cartlab_here("check", folder, *more)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    return done.stderr


def check(folder, *more) -> Done:
    return cartlab_here("check", folder, *more)


@pytest.fixture
def honest(tmp_path):
    """Write a submission whose numbers are right."""
    return a_submission(tmp_path / "team")


@pytest.fixture
def in_hertz(honest):
    """Write a submission whose first frequency is in Hz."""
    change(honest, "omega_n = 13.1", "omega_n = 2.085")
    return honest


def test_correct_numbers_end_with_status_0(honest):
    """If all numbers agree, the exit status is 0, and the folder records one check."""
    done = check(honest, "--rubric", RUBRIC)
    assert done.returncode == 0
    assert re.match(r"All \d+ ", done.stdout)
    assert len(read_answers(honest)) == 1


def test_an_unreadable_recording_is_named_with_its_reason(honest):
    """The answer quotes a mistyped file name and suggests the right one."""
    change(honest, "data/step-1.csv", "data/stp-1.csv")
    done = check(honest, "--rubric", RUBRIC)
    assert "data/stp-1.csv" in done.stdout
    assert "'data/step-1.csv'" in done.stdout


def test_the_second_answer_says_where_to_look(in_hertz):
    """The first answer names the wrong number, the second says where to look.

    Neither answer gives the right value, and the exit status is 1 both times.
    """
    first, second = check(in_hertz), check(in_hertz)
    assert (first.returncode, second.returncode) == (1, 1)
    assert "initial.omega_n" in first.stdout
    assert "Hz" not in first.stdout
    assert re.search(r"initial\.omega_n: Hz(.|\n)*decay(.|\n)* 2 times", second.stdout)
    for said in (first.stdout, second.stdout, (in_hertz / FILE).read_text(encoding="utf-8")):
        assert not re.search(r"13[.\d]|6\.28", said)


def test_after_a_change_the_answer_only_names_the_number(in_hertz):
    """After any change, the next answer says only which numbers disagree.

    Each run is counted.
    """
    check(in_hertz)
    change(in_hertz, "omega_n = 2.085", "omega_n = 9.0")
    again = check(in_hertz)
    assert "Hz" not in again.stdout
    assert [one.stage for one in read_answers(in_hertz)] == ["which", "which"]


def test_json_prints_the_line_that_is_added(in_hertz):
    """`--json` prints the same line that is added to the file of answers.

    The line follows the schema and contains no time.
    """
    schema = json.loads((ROOT / "docs" / "check.schema.json").read_text(encoding="utf-8"))
    lines = [check(in_hertz, "--json").stdout for _ in range(3)]
    assert (in_hertz / FILE).read_text(encoding="utf-8") == "".join(lines)
    for number, line in enumerate(lines, start=1):
        jsonschema.Draft202012Validator(schema).validate(json.loads(line))
        assert json.loads(line)["ask"] == number


def test_a_rubric_for_other_carts_is_refused(honest):
    """If the rubric is for another number of carts, one line says so and nothing is counted."""
    assert re.search("1 cart.* 2", refused(honest, "--rubric", "throne-2dof"))
    assert not (honest / FILE).exists()


def test_nothing_reported_cannot_be_checked(honest):
    """If no number is reported, the message says so."""
    path = honest / "submission.toml"
    text = path.read_text(encoding="utf-8").partition("[reported")[0]
    path.write_text(text, encoding="utf-8")
    assert "no number" in refused(honest)


@pytest.mark.parametrize(
    "text", ["", "\n", "{}\n", "no json\n", '{"ask": 1}\n', "[" * 100_000, "\x00", "\u2028\n"]
)
def test_an_edited_file_of_answers_is_refused(honest, text):
    """If the file of answers was edited, the check is refused and the file stays.

    An empty file is accepted.
    """
    (honest / FILE).write_text(text, encoding="utf-8")
    if text:
        assert f"{FILE}, line 1: " in refused(honest)
        assert (honest / FILE).read_text(encoding="utf-8") == text
    else:
        assert check(honest).returncode == 0


def test_a_missing_line_is_refused(in_hertz):
    """If a line of the file is missing, `cartlab check` refuses to answer.

    The lines are numbered, so a missing line is noticed.
    """
    for _ in range(3):
        check(in_hertz)
    _, *rest = (in_hertz / FILE).read_text(encoding="utf-8").splitlines(keepends=True)
    (in_hertz / FILE).write_text("".join(rest), encoding="utf-8")
    assert FILE in refused(in_hertz)


@pytest.mark.skipif(sys.platform == "win32", reason="links of POSIX")
def test_a_link_is_not_followed(honest, tmp_path):
    """If the file of answers is a link, the file that it points to is neither read nor written."""
    other = tmp_path / "other.txt"
    other.write_text("mine", encoding="utf-8")
    (honest / FILE).symlink_to(other)
    assert f"{FILE}: " in refused(honest)
    assert other.read_text(encoding="utf-8") == "mine"


def test_the_grade_says_how_often_the_check_was_run(in_hertz, tmp_path):
    """A note in the grade says how often the check was run, or that its file was changed.

    The note costs no points.
    """
    check(in_hertz)
    check(in_hertz)

    def note() -> str:
        task = HandIn(id="team", key="k", sources=(in_hertz,))
        graded = grade_hand_in(task, rubric=load_rubric(RUBRIC), scratch=tmp_path)
        return read_grade(graded.grade).notes[-1]

    assert "2 times" in note()
    (in_hertz / FILE).write_text("{}\n", encoding="utf-8")
    assert "was changed" in note()


def test_a_wrong_value_of_see_is_refused(honest, tmp_path):
    """If the key `see` of a rubric or submission is wrong, one line gives the allowed values."""
    rubric = tmp_path / "lab.toml"
    text = RUBRIC.read_text(encoding="utf-8")
    rubric.write_text(text + '\n[students]\nsee = "chekc"\n', encoding="utf-8")
    wrong = r"students\.see: .*'report' or 'check'.* 'chekc'"
    assert re.search(rf"lab\.toml line \d+: {wrong}", refused(honest, "--rubric", rubric))
    rubric.write_text(text + '\n[students]\nsee = "check"\n', encoding="utf-8")
    assert load_rubric(rubric).students.see == "check"
    change(honest, "[system]", '[students]\nsee = "all"\n\n[system]')
    assert re.search(wrong.replace("chekc", "all"), refused(honest))
