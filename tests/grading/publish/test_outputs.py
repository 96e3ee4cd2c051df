"""The files of a grading depend only on the gradebook; they are safe and complete."""

import csv
import io
import json
import re
from itertools import count
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ConfigError
from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.csv_table import read_table
from pipeline.grading.grade import CODES, Adjustment, Flag, Grade
from pipeline.grading.gradebook.decisions import read_points
from pipeline.grading.gradebook.events import Event, with_overrides
from pipeline.grading.gradescope import results_text
from pipeline.grading.publish.class_page import class_page
from pipeline.grading.publish.feedback import evidence_table, feedback_page, numbers_table
from pipeline.grading.publish.outputs import grades_csv, write_outputs
from pipeline.grading.publish.pseudonyms import KEY_FILE, anonymise, pseudonyms
from pipeline.grading.publish.view import new_view
from pipeline.grading.similarity.shared_flag import student_message
from pipeline.grading.words import WORDS
from pipeline.setup import Units
from pipeline.submission.models import Students
from pipeline.words.text import plain
from tests.helpers.grades import (
    book_of,
    failed_grade,
    finish,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
    write_class,
)

RUBRIC = two_cart_rubric()


def test_the_evidence_of_a_flag_keeps_its_words():
    """A flag's evidence shows which table is meant and which mistake explains it.

    True and false appear as yes and no.
    """
    evidence = {
        "parameter": "A[2,1]", "table": "initial", "reported": 3.0, "stable": False,
        "slip": "rows exchanged", "also_in": "final", "ran": [1.0], "gone": "",
    }  # fmt: skip
    flag = Flag(code="wrong_state_space", parameters=(), message="x", evidence=evidence)
    table = evidence_table(flag, units=None, numbers=count(1))
    assert table is not None
    assert [plain(head.text) for head in table.head] == [
        "Table", "Reported", "Stable", "Mistake", "Also in",
    ]  # fmt: skip
    shown = [plain(cell.text) for cell in table.rows[0]]
    assert shown == ["initial", "3", "no", "rows exchanged", "final"]
    assert table.align == "lrlll"


@pytest.fixture(scope="module")
def graded(tmp_path_factory) -> Path:
    """Write a class with all kinds of submissions."""
    return write_class(tmp_path_factory.mktemp("class"))


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_bytes().decode(), newline="")))


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of all files except the gradebook itself."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "gradebook.sqlite"
    }


# ------------------------------------------------------------------------ grades.csv


def test_every_submission_has_its_row(graded):
    """Every submission has a row in `grades.csv`; for a broken submission it gives the reason.

    The row has points by criterion, lateness and points given by hand.
    """
    rows = {row["submission"].lstrip("'"): row for row in rows_of(graded / "grades.csv")}

    assert len(rows) == 16
    broken = rows["broken"]
    assert (broken["status"], broken["points"], broken["pieces"]) == ("failed", "0", "")
    assert broken["reason"] == "submission.toml line 3: <b>cart</b> is no key"
    by_hand = rows["team-02"]  # 95 % of 20, with 1 instead of 0.95 for one criterion, one day late
    # 10 % of 19.05 is 1.905, rounded to 2 by the rubric's quarter of a point. The 95 % of 0.5 and
    # of 1.5 points have three decimals, of which two are kept: an error of 0.005 each.
    assert float(by_hand["points"]) == pytest.approx(19 - 0.95 + 1 - 2.0, abs=0.0101)
    assert (by_hand["laws"], by_hand["by_hand"], by_hand["remarks"]) == ("1", "laws", "shared_data")
    assert rows["team-03"]["pieces"] == "0.9"
    assert rows["team-05"]["authors"] == "s4 <script>alert(1)</script>"


def test_no_cell_is_a_formula(graded):
    """A cell that a spreadsheet would run as a formula begins with an apostrophe."""
    cells = [cell for row in rows_of(graded / "grades.csv") for cell in row.values()]
    assert "'=cmd'C'!A0" in cells
    assert not [cell for cell in cells if cell.startswith(tuple("=@\t\r"))]


def test_a_criterion_with_the_name_of_a_column_gets_another_heading():
    """A criterion whose id equals a fixed column's heading gets another heading."""
    criteria = (RUBRIC.criteria[0].model_copy(update={"id": "points"}),)
    rubric = RUBRIC.model_copy(update={"criteria": criteria})
    (head,) = csv.reader([grades_csv([], rubric=rubric).strip()])
    assert len(head) == len(set(head))
    assert "criterion points" in head


# ------------------------------------------------------------------------- the files


def test_the_same_class_gives_the_same_bytes(graded, tmp_path):
    """The same class gives the same bytes in another folder, even after other gradings."""
    again = write_class(tmp_path)
    assert tree(again) == tree(graded)


def test_markup_of_students_is_shown_as_text(graded):
    """Names, reasons and messages with markup appear as plain text on every page."""
    for path in (graded / "class.html", graded / "feedback" / "team-02" / "feedback.html"):
        html = path.read_text(encoding="utf-8")
        assert "<b>cart" not in html
        assert "<i>as told" not in html
        assert "<script>alert" not in html
    assert "&lt;b&gt;cart" in (graded / "class.html").read_text(encoding="utf-8")


def test_every_link_of_the_class_leads_to_feedback(graded):
    """Every link of the class page leads to a feedback page, whatever the submission's name."""
    html = (graded / "class.html").read_text(encoding="utf-8")
    links = set(re.findall(r'href="(feedback/[^"]*)"', html))
    assert len(links) == 16
    assert all((graded / unquote(link)).is_file() for link in links)


def test_grade_json_says_what_was_given_by_hand(graded):
    """`grade.json` gives the reason for points given by hand, but not the person."""
    text = (graded / "feedback" / "team-02" / "grade.json").read_text(encoding="utf-8")
    grade = json.loads(text)
    assert grade["schema"] == "cartlab-grade/1"
    assert grade["overrides"] == [
        {"criterion": "laws", "points": 1.0, "why": "right, <i>as told</i>"}
    ]
    assert "Ada" not in text
    assert grade["flags"][0]["code"] == "shared_data"


def test_only_what_changed_is_written_again(tmp_path):
    """Only changed feedback is written again; missing files are made and outdated ones removed."""
    teams = [make_grade(name, share=0.5) for name in "abc"]
    with book_of(tmp_path, *teams) as book:
        told: list[str] = []
        write_outputs(book, tmp_path, progress=told.append)
        first = tree(tmp_path)
        write_outputs(book, tmp_path, progress=told.append)
        assert (told, tree(tmp_path)) == ([f"feedback: {n}" for n in "abc"], first)

        book.override("b", "laws", 1.0, why="x", by="y")
        (tmp_path / "feedback" / "c" / "feedback.html").unlink()
        (tmp_path / "feedback" / "a" / "notes.txt").write_text("mine", encoding="utf-8")
        write_outputs(book, tmp_path, progress=told.append)
        assert told[3:] == ["feedback: b", "feedback: c"]

        finish(book, teams[1])
        write_outputs(book, tmp_path)
        assert sorted(p.name for p in (tmp_path / "feedback").iterdir()) == [".made.json", "a", "b"]
        assert [p.name for p in (tmp_path / "feedback" / "a").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["../out", "a/b", "..", ""])
def test_a_name_that_leads_outside_the_folder_is_refused(tmp_path, name):
    """If a submission's name would lead outside the folder, nothing is written."""
    with book_of(tmp_path / "g.sqlite", make_grade(name)) as book:
        (tmp_path / "out").mkdir()
        with pytest.raises(ConfigError, match="feedback folder"):
            write_outputs(book, tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").rglob("*") if p.is_file()] == []


# --------------------------------------------------------------------- without names


def test_an_anonymous_grading_reveals_no_name(tmp_path):
    """In anonymous grading, pages, table and order of rows reveal no name.

    Only the key file does.
    """
    zoe, ann = (
        make_grade("zoe-lab", authors=("zoe",), share=0.5),
        make_grade("ann-lab", authors=("ann",)),
    )
    bob = failed_grade("bob-lab", "bob-lab: no submission.toml")
    shared = {"zoe-lab": shared_flag("ann-lab"), "ann-lab": shared_flag("zoe-lab")}
    rubric, out = RUBRIC.model_copy(update={"anonymous": True}), tmp_path / "out"
    out.mkdir()
    with book_of(tmp_path / "g.sqlite", zoe, ann, bob, rubric=rubric, shared=shared) as book:
        write_outputs(book, out)
        before = tree(out)
        later = make_outcome(make_grade("ann-lab", authors=("ann",), share=0.2), key="later")
        finish(book, zoe, later, bob, rubric=rubric, shared=shared)
        write_outputs(book, out)

    key = {row["anonymous"]: row for row in rows_of(out / KEY_FILE)}
    assert {row["submission"] for row in key.values()} == {"zoe-lab", "ann-lab", "bob-lab"}
    names = [row["submission"] for row in rows_of(out / "grades.csv")]
    assert names == sorted(key)
    for name, content in tree(out).items():
        if name != KEY_FILE:
            told = re.sub(rb'url\("data:[^"]*"\)', b"", content)  # fonts are no text
            assert not re.search(rb"zoe|\bann\b|bob", told), name
            assert not re.search(r"zoe|ann-|bob", name)
    names = {row["authors"]: name for name, row in key.items()}
    flag = json.loads(before[f"feedback/{names['zoe']}/grade.json"])["flags"][0]
    assert flag["evidence"]["submissions"] == [names["ann"]]  # the pseudonym is as before
    assert names["ann"] in flag["message"]


def test_hiding_a_name_does_not_change_other_words():
    """Hiding teams named `3` or `step` does not change their feedback's numbers and experiments."""
    grade = make_grade("3", share=0.5, flags=(hertz_flag(), shared_flag("step")))
    hidden = anonymise(grade, {"3": "anon-a", "step": "anon-b"})
    assert [c.message for c in hidden.criteria] == [c.message for c in grade.criteria]
    assert hidden.flags[0] == grade.flags[0]
    assert re.match("step-1 .* anon-b: ", hidden.flags[1].message)
    assert hidden.flags[1].evidence["recordings"][0]["submission"] == "anon-b"


@pytest.mark.parametrize(
    ("reason", "shown"),
    [
        ("3/submission.toml line 3: no key", "anon-a/submission.toml line 3: no key"),
        ("doejane_1024_77_lab.zip: not a complete zip", "the archive: not a complete zip"),
    ],
)
def test_a_reason_names_nobody(reason, shown):
    """In an anonymous grading, a reason shows no folder or archive with a student's name."""
    assert anonymise(failed_grade("3", reason), {"3": "anon-a"}).reason == shown


def test_pseudonyms_are_all_different():
    """Ten thousand pseudonyms, computed from the submissions alone, are all different."""
    names = pseudonyms({f"team-{n}": f"key {n}" for n in range(10_000)})
    assert len(set(names.values())) == 10_000
    assert names["team-7"].startswith(pseudonyms({"renamed": "key 7"})["renamed"])


# -------------------------------------------------------------------------- the pages


def feedback_of(grade: Grade) -> str:
    return feedback_page(new_view(grade, RUBRIC), figures=(), name="team-1")


def test_every_flag_has_a_name_and_a_place_to_look():
    """Every flag has a title and a place to look."""
    for said in ("title", "place"):
        assert [k for k in WORDS.by_key if k.startswith(f"{said}_")] == [
            f"{said}_{c}" for c in CODES
        ]


def test_the_feedback_compares_reported_and_recomputed_numbers():
    """The feedback shows both numbers, their difference, each flag with help, and lateness."""
    flag = hertz_flag()
    html = feedback_of(make_grade("t", share=0.5, days_late=1.5, deducted=2.0, flags=(flag,)))
    text = re.sub(r"<[^>]+>", "", html)
    assert flag.message.partition("this")[2] in text
    assert WORDS.text(f"place_{flag.code}") in text
    assert re.search("1.5 days.*−2 points", text)
    assert re.search(r"\]3\.1219\.6−84\.1 %", text)


def test_feedback_on_shared_data_names_nobody_and_does_not_praise():
    """If data are shared, the feedback neither names the other team nor says "Well done"."""
    html = feedback_of(make_grade("team-1", flags=(shared_flag("b-team"),)))
    assert "another submission" in html
    assert "20 of 20" in html
    assert not re.search("b-team|Well done", html)


def test_feedback_says_why_a_submission_was_not_graded():
    """It gives the reason; a mark is shown only if the submission is at fault or has points.

    If a limit ended the grading, the staff act; if a person gave points, nobody hands in again.
    """
    fault = failed_grade("team-1", "no submission.toml in it")
    stopped = fault.model_copy(update={"unsettled": True})
    adjusted = {"points": 5.0, "adjustments": (Adjustment(points=5.0, why="read by eye"),)}
    given = Event(what="override", criterion=RUBRIC.criteria[0].id, points=1.0, text="x")
    by_hand = with_overrides(fault, {given.criterion: given}, rubric=RUBRIC)
    pages = [fault, stopped, stopped.model_copy(update=adjusted), by_hand]
    texts = [re.sub(r"<[^>]+>", "", feedback_of(grade)) for grade in pages]
    assert all("submission.toml in it" in text for text in texts)
    assert ["hand it in" in text for text in texts] == [True, False, False, False]
    marks = [found and found[0] for text in texts if (found := re.search(r"\d of 20", text)) or 1]
    assert marks == ["0 of 20", None, "5 of 20", "1 of 20"]
    told = json.loads(results_text(new_view(by_hand, RUBRIC)))["output"]
    assert "given by hand" in told


@pytest.mark.slow
@pytest.mark.sample
def test_feedback_lists_every_mistake_of_a_broken_submission(tmp_path):
    """If a submission's file has three mistakes, the feedback lists them in three lines.

    In the table they share one cell.
    """
    folder = tmp_path / "class" / "team-1"
    (folder / "data").mkdir(parents=True)
    text = 'version = 1\n[system]\ncarts = 2\nspring = [true]\n[design]\ncart = "two"\n[reportd]\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    out = tmp_path / "grades"
    options = Options(figures=False)
    grade_class([folder], rubric_file=Path("throne-2dof"), out=out, options=options)
    html = (out / "feedback" / "team-1" / "feedback.html").read_text(encoding="utf-8")
    wanted = ("system.spring: ", "design.cart: ", "reportd: ")
    for words in wanted:
        assert sum(words in item for item in re.findall(r"<li>(.*?)</li>", html)) == 1
    assert "more)" not in html
    (row,) = csv.DictReader((out / "grades.csv").read_text(encoding="utf-8").splitlines())
    assert all(words in row["reason"] for words in wanted)


def shown_numbers(name: str, found: float | None, expected: float, *, check: str) -> list[str]:
    """Return the cells of the feedback's row for one number."""
    own = make_grade("a").criteria[0]
    typed = {} if found is None else {name: found}
    own = own.model_copy(update={"expected": {name: expected}, "found": typed})
    units = Units(position="cm", input="V")
    table = numbers_table(own, check=check, units=units, numbers=count(1))
    assert table is not None
    return [plain(cell.text) for cell in table.rows[0]]


@pytest.mark.parametrize(
    ("name", "found", "expected", "cells"),
    [
        # an overshoot of 10⁻⁷ % is shown as 0, and differs by percentage points
        ("overshoot_percent", 0.0, 3.7e-7, ["Overshoot [%]", "0", "0", "0"]),
        ("overshoot_percent", 22.0, 3.7e-7, ["Overshoot [%]", "22", "0", "+22 percentage points"]),
        ("settling_time", 0.6, 0.5, ["Settling time [s]", "0.6", "0.5", "+20.0 %"]),
        ("prefilter", 0.14, 0.07, ["Prefilter [V/cm]", "0.14", "0.07", "+100 %"]),
        # above ten times the recomputed number, the ratio is given instead of percent
        ("settling_time", 20.0, 2.0, ["Settling time [s]", "20", "2", "+900 %"]),
        ("settling_time", 2538.0, 2.0, ["Settling time [s]", "2538", "2", "1269 times"]),
        ("settling_time", -2538.0, 2.0, ["Settling time [s]", "−2538", "2", "−1269 times"]),
    ],
)
def test_numbers_of_a_criterion_have_words_and_units(name, found, expected, cells):
    """A criterion's number has a label, its unit, both values and their difference."""
    assert shown_numbers(name, found, expected, check="claims") == cells


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("K_1", "cm/V"), ("omega_a", "rad/s"), ("zeta_2", ""), ("mass", "V\xa0s²/cm"),
        ("A(2, 1)", "1/s²"), ("A(4, 4)", "1/s"), ("A(1, 2)", ""),
        ("B(2)", "cm/(V\xa0s²)"), ("B(1)", ""),
    ],
)  # fmt: skip
def test_a_number_has_its_unit(name, unit):
    """Each parameter and each entry of A and B is shown with its unit."""
    label = shown_numbers(name, None, 1.0, check="final")[0]
    assert label.endswith(f" [{unit}]") if unit else "[" not in label


_VALUES = (
    st.none()
    | st.booleans()
    | st.floats()
    | st.text(max_size=8)
    | st.lists(st.integers(), max_size=2)
)


@settings(max_examples=40)
@given(st.dictionaries(st.text(max_size=8), _VALUES, max_size=4))
def test_any_numbers_can_be_shown(values):
    """Whatever the numbers of a criterion are, the page has no control characters.

    The numbers may be infinite, missing, nested or text.
    """
    grade = make_grade("team-1", share=0.5)
    found = dict(reversed(values.items()))
    first = grade.criteria[0].model_copy(update={"expected": values, "found": found})
    grade = make_grade("team-1", criteria=(first, *grade.criteria[1:]))
    html = feedback_of(grade)
    assert not re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f]", html)


@pytest.mark.parametrize(("points", "percent"), [(19.95, "99"), (4.6, "23")])
def test_only_full_points_are_100_percent(points, percent):
    """Percentages are computed from the decimals as typed and rounded down.

    So only full points are shown as 100 %.
    """
    page = class_page([make_grade("a", points=points)], rubric=RUBRIC)
    cells = re.sub(r"<[^>]+>", " ", page.split("All submissions.")[-1]).split()
    assert cells[cells.index(str(points)) + 1] == percent


def test_the_class_page_shows_statistics():
    """The class page shows mean and median, outcomes per criterion, and teams per mistake."""
    grades = [make_grade("a"), make_grade("b", share=0.5, flags=(hertz_flag(),)),
              make_grade("c", share=0.0, flags=(hertz_flag(), missing_flag()))]  # fmt: skip
    lines = [*grades, failed_grade("d", "broken")]
    html = re.sub(r"<[^>]+>", " ", class_page(lines, rubric=RUBRIC))
    text = " ".join(html.split())
    assert re.search("graded 1 .*3 graded 10.00 of 20 .*3 graded 10.00 of 20", text)
    assert "1 50 % 1 1 1 0" in text
    assert re.search(r"hz_for_rad_s \) 2 50 % b , c .* missing \) 1 25 % c ", text)


def shares(*found: tuple[str, str, str]) -> Flag:
    """Return a flag for shared data.

    Each argument names a recording, the submission that shares it, and its name there.
    """
    keys = ("experiment", "submission", "other_experiment")
    recordings = [{**dict(zip(keys, one, strict=True)), "sigmas": 9.5} for one in found]
    evidence = {"submissions": [], "recordings": recordings}
    return shared_flag("x").model_copy(update={"evidence": evidence})


def test_the_class_page_lists_groups_that_share_recordings(tmp_path):
    """The class page lists groups that share recordings.

    A submission of an earlier batch is named without a link.
    """
    shared = {
        "a": shares(("step-1", "b", "step-2"), ("sine-1", "b", "sine-1")),
        "b": shares(("step-2", "a", "step-1"), ("sine-1", "a", "sine-1"), ("d", "c", "d")),
        "c": shares(("d", "b", "d")),
        "e": shares(("d", "old (an earlier batch)", "d")),
    }
    class_ = [make_grade(name) for name in "abcde"]
    with book_of(tmp_path / "g.sqlite") as book:
        texts = {}
        for anonymous in (False, True):
            rubric = RUBRIC.model_copy(update={"anonymous": anonymous})
            finish(book, *class_, rubric=rubric, shared=shared)
            write_outputs(book, tmp_path)
            html = (tmp_path / "class.html").read_text(encoding="utf-8")
            found = re.search(r'id="shared".*?(<tbody.*?)</table>', html, re.DOTALL)
            assert found
            rows = re.findall(r"<tr.*?</tr>", found[1], re.DOTALL)
            texts[anonymous] = [" ".join(re.sub(r"<[^>]+>", " ", row).split()) for row in rows]
    assert texts[False] == [
        "1 a , b 2 sine-1, step-1 (step-2 in b)",
        "1 b , c 1 d",
        "2 e , old (an earlier batch) 1 d",
    ]
    assert len(texts[True]) == 3
    assert not [text for text in texts[True] if re.search(r"\b[abce]\b|old", text)]
    assert [text for text in texts[True] if re.search(r"anon-\w+ , another submission", text)]


def test_the_data_frame_has_a_row_for_each_criterion(tmp_path):
    """The data frame of a class has one row for each submission and criterion.

    A criterion that was never judged has no points.
    """
    class_ = [make_grade("a", authors=("ann", "bo"), flags=(hertz_flag(),)),
              make_grade("b", share=0.5, days_late=1.0, deducted=1.0, points=9.0),
              failed_grade("c", "broken")]  # fmt: skip
    with book_of(tmp_path, *class_) as book:
        book.override("c", "pieces", 0.75, why="x", by="y")
        write_outputs(book, tmp_path)
        frame = book.to_frame()
    ids = [criterion.id for criterion in RUBRIC.criteria]
    assert frame["submission"].to_list() == [name for name in "abc" for _ in ids]
    assert frame["criterion"].to_list() == 3 * ids
    wide = frame.pivot(index="submission", columns="criterion", values="points")
    assert wide.sum(axis="columns").to_dict() == {"a": 20.0, "b": 10.0, "c": 0.75}
    assert wide.count(axis="columns").to_dict() == {"a": len(ids), "b": len(ids), "c": 1}
    totals = frame.pivot(index="submission", columns="criterion", values="total")["pieces"]
    assert totals.to_list() == [20.0, 9.0, 0.75]
    by_hand = frame.loc[frame["by_hand"], ["submission", "criterion"]]
    assert by_hand.to_numpy().tolist() == [["c", "pieces"]]
    first = frame.loc[0, ["authors", "remarks", "outcome"]]
    assert first.to_list() == ["ann bo", "hz_for_rad_s", "pass"]
    table = pd.read_csv(tmp_path / "grades.csv").set_index("submission")
    assert (table[ids].fillna(-1).to_numpy() == wide[ids].fillna(-1).to_numpy()).all()


def missing_flag() -> Flag:
    return Flag(code="missing", parameters=("K_1",), message="K_1 is missing.", evidence={})


@pytest.mark.parametrize("grades", [[], [failed_grade("a", "broken")]])
def test_a_class_without_grades_has_a_page(grades):
    """A class has a page even if nobody submitted or nothing could be graded."""
    html = class_page(grades, rubric=RUBRIC)
    assert "Submissions" in html


def test_points_are_read_as_typed():
    """Points are read with a decimal point or comma; `auto` means the automatic points."""
    assert [read_points(text) for text in ("2", "1,5", "AUTO")] == [2.0, 1.5, None]
    with pytest.raises(ConfigError, match="two: "):
        read_points("two")


def test_a_table_of_a_platform_is_read_whatever_its_separators(tmp_path):
    """A table may have semicolons, tabs, a byte-order mark or blank lines.

    Each row keeps its line number.
    """
    path = tmp_path / "t.csv"
    path.write_text('\ufeffa;b\n\n"x\ny";"1;2"\n', encoding="utf-8")
    table = read_table(path)
    assert list(table.columns) == ["a", "b"]
    assert list(table.itertuples(name=None)) == [(4, "x\ny", "1;2")]
    path.write_text("a,b\n1\n1,2,3\n", encoding="utf-8")
    assert list(read_table(path).itertuples(name=None)) == [(2, "1", ""), (3, "1", "2")]
    path.write_bytes(b"a,b\n\xff\xfe,1\n")
    with pytest.raises(ConfigError, match=r"t\.csv: .*UTF-8"):
        read_table(path)
    for much in ("a\n" * 200_000, "," * 5_000):
        path.write_text(f"a{much}\n", encoding="utf-8")
        with pytest.raises(ConfigError, match=r"t\.csv: .*\b2000\b.*\b100000\b"):
            read_table(path)


@pytest.mark.parametrize(
    ("rubric", "user", "hides"),
    [("report", None, False), ("check", None, True), ("report", "check", True),
     ("check", "report", False)],
)  # fmt: skip
def test_what_a_person_may_see_decides_over_the_rubric(rubric, user, hides):
    """`new_view` hides numbers by the list of users if it says so, else by the rubric."""
    asked = two_cart_rubric().model_copy(update={"students": Students(see=rubric)})
    assert new_view(make_grade("team-1"), asked, see=user).hides_numbers == hides


def test_a_student_is_not_told_whose_recording_it_is():
    """The `student_message` of shared recordings names no other team."""
    flag = shared_flag("team-77")
    assert "team-77" in flag.message
    assert "team-77" not in student_message(flag)
