"""A reported number that cannot be read costs that number, and a table that table."""

import re
import time
from pathlib import Path

import pytest

from pipeline.desk.student.folder_tasks import students_see
from pipeline.errors import SubmissionError
from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import (
    analyse_under,
    grade_analysis,
    grade_submission,
    under_rubric,
)
from pipeline.grading.rubric_file import load_rubric
from pipeline.report.document import plain_lines
from pipeline.report.sections.summary import next_steps
from pipeline.simulated.submission import write_submission
from pipeline.submission import Reported, Submission, load_submission
from pipeline.submission.edit import edit_submission
from pipeline.words.progress import silent
from pipeline.workflow import analyse
from tests.helpers.commandline import cartlab_here

TEXT = "\n".join(
    (
        "version = 1",
        "[system]",
        "carts = 2",
        "[reported.initial]",
        "K_1 = 25.6",
        "omega_a = 10.0",
        "[reported.final]",
        "K_1 = 24.3",
        "omega_a = 10.1",
        "zeta_a = 0.1",
        "[reported.state_space]",
        "A = [[0, 1, 0, 0], [-1, -2, 3, 0], [0, 0, 0, 1], [4, 0, -5, -6]]",
        "B = [0, 3196.70, 0, 0]",
        "[reported.feedback]",
        "gains = [1, 2, 3, 4]",
        "prefilter = 2.5",
        "",
    )
)
LINE_9 = "omega_a = 10.1"
ROWS = TEXT.replace("[[0, 1", "[\n  [0, 1").replace("], [", "],\n  [").replace("-6]]", "-6]\n]")


def read(folder: Path, text: str) -> Submission:
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    return load_submission(folder)


def line_of(message: str) -> int:
    """Return the line of `submission.toml` that a message names; 0 if it names none."""
    named = re.search(r"submission\.toml line (\d+): ", message)
    return int(named[1]) if named else 0


def advice(message: str) -> list[str]:
    """Return the line that a message says to write, if it says any."""
    return re.findall(r"write (\S+ = [^;\s]+)", message)


def numbers(reported: Reported | None) -> set[str]:
    """Return the dotted names of all reported numbers and matrices."""
    reported = reported or Reported()
    found = {f"{table}.{n}" for table in ("initial", "final") for n in getattr(reported, table)}
    for table in ("state_space", "feedback"):
        for name, value in getattr(reported, table) or ():
            found |= {f"{table}.{name}"} if value not in (None, ()) else set()
    return found


@pytest.mark.parametrize(
    ("typed", "says", "write"),
    [
        ("omega_a = 10,1", "comma", "omega_a = 10.1"),
        ("omega_a = 1,234.5", "comma", ""),
        ('omega_a = "n/a"', "'n/a'", ""),
        ("omega_a = n/a", "digits", ""),
        ("omega_a = ten", "digits", ""),
        ("omega_a = nan", "NaN", ""),
        ("omega_a = -inf", "-Infinity", ""),
        ("omega_a = 1e999999999999", "1e+30", ""),
        (f"omega_a = {'1' * 5000}", "digits", ""),
        ("omega_a = 10.1 rad/s", "unit", "omega_a = 10.1"),
        ("omega_a = 1.6 Hz", "unit", ""),  # the number alone would be in Hz
        ("omega_a = 2*pi*1.6", "formula", ""),
        ("omega_a = 10.1 ± 0.2", "only", "omega_a = 10.1"),
        ("omega_a = 10.1 // from the fit", "only", ""),
        ("omega_a = 10 1", "number", ""),
        ("omega_a = 10.1.2", "number", ""),
        ("omega_a = 10.1.", "number", "omega_a = 10.1"),
        ("omega_a = .5", "point", "omega_a = 0.5"),
        ("omega_a = 1,01·10^1", "comma", "omega_a = 1.01e1"),
        ("omega_a =", "missing", ""),
        ("omega_a = [10.1]", "[10.1]", ""),
        ("omega_a: 10.1", "=", "omega_a = 10.1"),
        ("omega_a 10.1", "=", "omega_a = 10.1"),
        ("omega a = 10.1", "=", "omega_a = 10.1"),
        ("omega_a = −10.1", "minus", "omega_a = -10.1"),
        ("omega_a = −10,1 rad/s # ours", "minus", "omega_a = -10.1"),
        ('omega_a = "10.1', "quote", "omega_a = 10.1"),
        ('omega_a = "24,3"', "'24,3'", "omega_a = 24.3"),
        ("omega_a = “10.1”", "curly", "omega_a = 10.1"),
        ("omega_A = 10.1", "'omega_a'", ""),
        ("ω_a = 10.1", "letters", "omega_a = 10.1"),
        ("ωₐ = 10,1", "", "omega_a = 10.1"),
        ("ω₁: 10.1", "", "omega_1 = 10.1"),
    ],
)
def test_a_number_that_cannot_be_read_costs_this_number(tmp_path, typed, says, write):
    """One mistyped number is left out; its message has the line, and what to write if certain."""
    whole = numbers(read(tmp_path, TEXT).reported)
    found = read(tmp_path, TEXT.replace(LINE_9, typed))
    assert whole - numbers(found.reported) == {"final.omega_a"}
    (part,) = found.unread
    assert part.at[:2] == ("reported", "final")
    assert line_of(part.message) == 9
    assert says in part.message
    assert advice(part.message) == [write] * bool(write)
    assert not re.search("write ;|TOML", part.message)
    if write:
        assert not read(tmp_path, TEXT.replace(LINE_9, write)).unread


@pytest.mark.parametrize(
    ("text", "lost", "says"),
    [
        (TEXT.replace("-6]]", "-6]"), "state_space.A", ""),
        (TEXT.replace("3, 0],", "3, 0,"), "state_space.A", ""),
        (TEXT.replace("-2, 3, 0]", "-2,5 3, 0]"), "state_space.A", ""),
        (TEXT.replace("[-1, -2, 3, 0]", "[-1 -2 3 0]"), "state_space.A", ""),
        (TEXT.replace("[0, 0, 0, 1], ", ""), "state_space.A", ""),
        (TEXT.replace("-2, 3, 0]", "-2, nan, 0]"), "state_space.A", ""),
        (ROWS.replace("[-1, -2", "[-1, n/a"), "state_space.A", ""),
        (ROWS.replace("[4, 0", "[n/a, 0"), "state_space.A", ""),
        (ROWS.replace("-6]\n]", "-6]\n"), "state_space.A", ""),
        (ROWS.replace("3, 0],", "3, 0]"), "state_space.A", ""),
        (TEXT.replace("3196.70, 0, 0]", "3196.70, 0, 0"), "state_space.B", ""),
        (TEXT.replace("gains = [1, 2, 3, 4]", "gains = [1, 2, 3, 4"), "feedback.gains", ""),
        (TEXT.replace("gains = [1, 2, 3, 4]", "gains = 1, 2, 3, 4]"), "feedback.gains", ""),
        (TEXT.replace("[1, 2, 3, 4]", "[1, 2, 3]"), "feedback.gains", "3"),
        (TEXT.replace("[1, 2, 3, 4]", "[1,1, 2,2, 3,3, 4,4]"), "feedback.gains", "1.5"),
        (TEXT.replace("[1, 2, 3, 4]", "[1,1; 2,2; 3,3; 4,4]"), "feedback.gains", "commas"),
        (TEXT.replace("[1, 2, 3, 4]", "[1 2 3 4]"), "feedback.gains", "comma"),
        (TEXT.replace("[1, 2, 3, 4]", '["1", "2", "3", "4"]'), "feedback.gains", "'1'"),
        (TEXT.replace("[0, 3196.70, 0, 0]", "[0; 3196.70; 0; 0]"), "state_space.B", "commas"),
        (TEXT.replace("prefilter", "perfilter"), "feedback.prefilter", "'prefilter'"),
    ],
)
def test_a_list_that_cannot_be_read_costs_this_list(tmp_path, text, lost, says):
    """A matrix or list with a wrong bracket, comma or entry is left out; the rest is read."""
    whole = numbers(read(tmp_path, TEXT).reported)
    found = read(tmp_path, text)
    assert whole - numbers(found.reported) == {lost}
    (part,) = found.unread
    assert says in part.message


def test_a_mistake_in_a_row_of_a_matrix_names_its_line(tmp_path):
    """In a matrix over several lines, the message names the line with the mistake."""
    (part,) = read(tmp_path, ROWS.replace("[4, 0", "[n/a, 0")).unread
    line = ROWS[: ROWS.index("[4, 0")].count("\n") + 1
    assert line_of(part.message) == line == 16


@pytest.mark.parametrize(
    "heading",
    [
        "[reported.final",
        "reported.final]",
        "[reported final]",
        "(reported.final)",
        "[reported.finl]",
    ],
)
def test_a_table_that_cannot_be_read_costs_this_table(tmp_path, heading):
    """A table with a wrong heading is left out; its numbers do not go to another table."""
    whole = numbers(read(tmp_path, TEXT).reported)
    found = read(tmp_path, TEXT.replace("[reported.final]", heading))
    assert whole - numbers(found.reported) == {"final.K_1", "final.omega_a", "final.zeta_a"}
    (part,) = found.unread
    assert line_of(part.message) == 7


@pytest.mark.parametrize(
    ("heading", "part"),
    [("[[reported.final]]", ("reported", "final")), ("[[reported]]", ("reported",))],
)
def test_a_table_in_double_brackets_costs_this_table(tmp_path, heading, part):
    """A list of tables is no table of numbers; the message tells how a table starts."""
    whole = numbers(read(tmp_path, TEXT).reported)
    found = read(tmp_path, TEXT.replace("[reported.final]", heading))
    assert whole - numbers(found.reported) == {"final.K_1", "final.omega_a", "final.zeta_a"}
    (lost,) = found.unread
    assert lost.at == part
    assert line_of(lost.message) == 7
    assert "[name]" in lost.message


def test_a_number_in_place_of_all_tables_costs_the_tables(tmp_path):
    """With `reported = 5`, the rest of the submission is read."""
    found = read(tmp_path, TEXT.replace("version = 1", "version = 1\nreported = 5"))
    assert numbers(found.reported) == set()
    assert found.unread[-1].at == ("reported",)


def test_a_table_typed_twice_with_a_wrong_name_names_its_first_line(tmp_path):
    """The message leads to the first of two headings with the same mistake."""
    text = TEXT.replace("[reported.final]", "[reported.finl]")
    found = read(tmp_path, f"{text}[reported.finl]\nK_2 = 1.0\n")
    assert [line_of(part.message) for part in found.unread] == [7]


def test_all_numbers_may_be_unreadable(tmp_path):
    """A table full of nan, and four kinds of mistakes, cost the numbers that have them."""
    every = TEXT.replace("25.6", "nan").replace("10.0", "nan").replace("24.3", "nan")
    found = read(tmp_path, every.replace("10.1", "inf").replace("0.1\n", "nan\n"))
    assert len(found.unread) == 5
    four = TEXT.replace("25.6", "25,6").replace("10.0", '"x"').replace("24.3", "nan")
    found = read(tmp_path, four.replace("omega_a = 10.1", "omega_q = 10.1"))
    at = {".".join(part.at[1:]) for part in found.unread}
    assert at == {"initial.K_1", "initial.omega_a", "final.K_1", "final.omega_q"}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("carts = 2", "carts = 2,0", "carts = 2.0"),
        ("carts = 2", 'carts = "two"', "system.carts"),
        ("[system]", "[system", "[system"),
        ("version = 1", "versoin = 1", "versoin"),
    ],
)
def test_a_mistake_elsewhere_is_the_only_one_told(tmp_path, old, new, said):
    """A mistake outside `[reported]` is an error; a number that cannot be read does not hide it."""
    text = TEXT.replace(old, new)
    for one in (text, text.replace("25.6", "25,6").replace("10.1", "n/a"), reordered(text)):
        with pytest.raises(SubmissionError) as told:
            read(tmp_path, one.replace("10.1", "10,1"))
        assert said in str(told.value)
        assert not re.search("reported|omega_a", str(told.value))


def reordered(text: str) -> str:
    """Return the file with its reported numbers before `[system]`."""
    head, system, reported = re.split(r"(?m)^(?=\[system|\[reported.initial)", text, maxsplit=2)
    return head + reported + system


def test_a_value_typed_twice_names_both_lines(tmp_path):
    """A name with two values costs this number only, wherever the second value is."""
    for second in ("omega_a = 10.2\n", "[reported.final]\nomega_a = 10.2\n"):
        found = read(tmp_path, TEXT.replace("zeta_a = 0.1\n", f"zeta_a = 0.1\n{second}"))
        (part,) = found.unread
        assert part.at == ("reported", "final", "omega_a")
        assert re.findall(r"line (\d+)", part.message) == [str(11 + second.count("[")), "9"]
        assert found.reported
        assert set(found.reported.final) == {"K_1", "zeta_a"}


@pytest.mark.parametrize(
    "text",
    [
        "version = 1\nreported.final.K_1 = 24,3\nreported.final.K_2 = 2.5\n[system]\ncarts = 2\n",
        "version = 1\n[system]\ncarts = 2\n[reported]\nfinal.K_1 = 24,3\nfinal.K_2 = 2.5\n",
        "version = 1\n[reported]\nfinal.K_1 = 24,3\nfinal.K_2 = 2.5\n[system]\ncarts = 2\n",
        "version = 1\r\n[reported.final]\r\nK_1 = 24,3\r\nK_2 = 2.5\r\n[system]\r\ncarts = 2",
        'version = 1\n[reported."final"]\n"K_1" = 24,3\n"K_2" = 2.5\n[system]\ncarts = 2\n',
    ],
)
def test_any_form_of_table_is_read_apart(tmp_path, text):
    """Dotted keys, quoted keys, Windows line ends: the mistake costs its number only."""
    found = read(tmp_path, text)
    (part,) = found.unread
    assert part.at == ("reported", "final", "K_1")
    assert numbers(found.reported) == {"final.K_2"}


@pytest.mark.parametrize("many", ["[\n" * 300_000, '"x' * 450_000])
def test_a_long_mistake_takes_little_time(tmp_path, many):
    """The time to find a mistake grows with its length only."""
    begin = time.process_time()
    found = read(tmp_path, TEXT.replace("zeta_a = 0.1\n", f"zeta_a = 0.1\n{many}\n"))
    assert len(found.unread) == 1
    assert time.process_time() - begin < 20  # s; 0.4 to 3 are usual


def test_very_many_mistakes_are_refused(tmp_path):
    """A table of thousands of mistakes is refused at once."""
    many = "".join(f"a{i} = x\n" for i in range(50_000))
    with pytest.raises(SubmissionError, match=r"\[reported\].*\b200\b"):
        read(tmp_path, TEXT.replace("zeta_a = 0.1\n", many))


def test_a_number_that_cannot_be_read_does_not_show_the_report(tmp_path):
    """A lab in which students find the numbers stays one if a number cannot be read."""
    text = TEXT.replace("10.1", "10,1") + '[students]\nsee = "check"\n'
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    assert students_see(str(tmp_path), progress=silent) == "check"


def test_an_edit_still_needs_a_valid_file(tmp_path):
    """A program does not edit a file with a number that cannot be read."""
    read(tmp_path, TEXT.replace("10.1", '"n/a"'))
    with pytest.raises(SubmissionError, match=r"omega_a.*'n/a'"):
        edit_submission(tmp_path, lambda document: document.update({"title": "t"}))


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Return a function that grades an edit of the final table of a right submission."""
    folder = tmp_path_factory.mktemp("typos") / "team-07"
    write_submission(folder, "throne-2dof", seed=3, compact=True, reported=True)
    rubric = load_rubric(Path("throne-2dof"))
    analysis = analyse_under(load_submission(folder), rubric=rubric).analysis
    toml = folder / "submission.toml"
    text = toml.read_text("utf-8")

    def grade(old: str, new: str) -> Grade:
        head, final = text.split("[reported.final]")
        final = re.sub(old, new, f"[reported.final]{final}", count=1, flags=re.MULTILINE)
        toml.write_text(head + final, "utf-8", newline="\n")
        submission, _ = under_rubric(load_submission(folder), rubric)
        return grade_analysis(submission, analysis, rubric=rubric, name="t").grade

    return grade


@pytest.mark.parametrize(
    ("old", "new", "losing"),
    [
        ("^(omega_a = .*)", r"\1", set()),
        ("^(omega_a = 1.).", r"\1,", {"pieces", "final-frequencies"}),
        ("^omega_a = .*", 'omega_a = "n/a"', {"pieces", "final-frequencies"}),
        ("^omega_a =.*", "omega_a =", {"pieces", "final-frequencies"}),
        ("^omega_1", "omega1", {"pieces", "final-frequencies"}),
        # What is left out, not mistyped, cannot satisfy a law; a zero says no more.
        ("^omega_a =.*", "omega_a = 0", {"final-frequencies", "laws"}),
        ("^omega_a =.*", "", {"pieces", "final-frequencies", "laws"}),
    ],
)
def test_a_mistyped_number_costs_only_itself(judged, old, new, losing):
    """The laws of the table are judged without a number that cannot be read."""
    grade = judged(old, new)
    assert {c.id for c in grade.criteria if c.points < c.out_of} == losing


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("^omega_1", "omega1", "'omega_1'"),
        (r"^\[reported.final\]", "[reported.finale]", "'final'"),
        (r"^\[reported.feedback\]", "", "state_space.prefilter"),
        (r"^\[reported.state_space\]", "[reported.statespace]", "'state_space'"),
    ],
)
def test_a_wrong_name_is_said_where_its_number_is_missing(judged, old, new, said):
    """The feedback quotes the mistyped name of a number or table."""
    (missing,) = (c for c in judged(old, new).criteria if c.id == "pieces")
    assert line_of(missing.message)
    assert said in missing.message


@pytest.mark.slow
@pytest.mark.sample
def test_one_typo_costs_one_number_in_grading(tmp_path):
    """With one decimal comma, the criterion says so; everything else is graded as before.

    `report` and `check` say it too. The report goes on.
    """
    folder = tmp_path / "team-07"
    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    toml = folder / "submission.toml"
    head, final = toml.read_text("utf-8").split("[reported.final]")
    line = next(line for line in final.split("\n") if line.startswith("omega_n = "))
    text = f"{head}[reported.final]{final.replace(line, line.replace('.', ','), 1)}"
    toml.write_text(text, "utf-8", newline="\n")
    submission = load_submission(folder)
    grade = grade_submission(submission, rubric=load_rubric(Path("throne-1dof")), name="t").grade
    lost = {c.id: c for c in grade.criteria if c.points < c.out_of}
    assert set(lost) == {"pieces", "final-frequencies"}
    found = lost["final-frequencies"].message
    assert advice(found) == [line]
    assert [flag.code for flag in grade.flags] == ["missing"]
    analysis = analyse(submission)
    assert [line] in map(advice, analysis.warnings)
    assert advice(plain_lines([next_steps(analysis)])) == [line]
    done = cartlab_here("check", folder)
    assert line not in done.stderr
    assert line_of(done.stdout) == text.split("\n").index(line.replace(".", ",")) + 1
    assert advice(done.stdout) == [line]
