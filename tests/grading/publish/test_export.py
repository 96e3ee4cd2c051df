"""Exported files follow the rules of each platform's importer."""

import csv
import io
import json
import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.publish.export import export
from pipeline.grading.publish.students import students_of
from tests.helpers.grades import (
    failed_grade,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

RUBRIC = two_cart_rubric()


def write(tmp_path: Path, *outcomes, platform, roster: str = "", overrides=(), **options):
    """Export a class; return the rows of the exported table and the messages."""
    with Gradebook(tmp_path / "g.sqlite", assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
        book.finish(Batch(keys=tuple(o.key for o in outcomes), shared={}), rubric=RUBRIC)
        for team, criterion, points in overrides:
            book.override(team, criterion, points, why="x", by="y")
        if roster:
            (tmp_path / "roster.csv").write_text(roster, encoding="utf-8-sig")
            options["roster"] = tmp_path / "roster.csv"
        done = export(book, platform, tmp_path / "out", **options)
    text = done.files[0].read_bytes().decode()
    said = tuple(remark.text for remark in done.remarks)
    return list(csv.reader(io.StringIO(text, newline=""))), said


def test_0_points_count_more_than_no_grade(tmp_path):
    """If an author has an ungraded submission and one with 0 points, the 0 points are exported."""
    unread = failed_grade("a", "too slow")
    unread = unread.model_copy(update={"authors": ("bob",)})
    nothing = make_grade("b", share=0.0, authors=("bob",))
    outcomes = make_outcome(unread), make_outcome(nothing)
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
        book.finish(Batch(keys=tuple(o.key for o in outcomes), shared={}), rubric=RUBRIC)
        for order in (1, -1):
            (bob,), _ = students_of(list(book.entries())[::order], platform="canvas")
            assert (bob.grade.submission, bob.points) == ("b", "0")


def canvas_import(rows: list[list[str]]) -> dict[str, dict[str, str]]:
    """Read grades by the rules of Canvas's `gradebook_importer.rb`.

    Return the points by assignment and student.
    """
    head = rows[0]
    assert len(head) > 3
    assert "Student" in head[0]
    assert "ID" in head[1]
    columns = 3
    assert re.search(r"SIS\s+User\s+ID", head[2])
    assert re.search(r"SIS\s+Login\s+ID", head[3])
    columns += 2 + ("Integration ID" in head[4])
    columns += "Root Account" in head[columns - 1]
    assert "Section" in head[columns - 1]  # the last column that describes the student
    grades: dict[str, dict[str, str]] = {title: {} for title in head[columns:]}
    for row in rows[1:]:
        if "Points Possible" in row[0]:
            assert [float(cell) for cell in row[columns:]] == [20.0] * len(grades)
            continue
        who = row[1] or row[2] or row[3] or row[0]
        for title, cell in zip(grades, row[columns:], strict=True):
            grades[title][who] = cell
    return grades


def moodle_import(rows: list[list[str]]) -> dict[str, tuple[str, str]]:
    """Read a worksheet by the rules of Moodle's `importgradeslib.php`.

    Return grade and feedback by participant.
    """
    head = rows[0]
    at = {name: head.index(name) for name in ("Identifier", "Grade", "Feedback comments")}
    assert "Last modified (grade)" in head
    return {
        row[at["Identifier"]].removeprefix("Participant "): (
            row[at["Grade"]],
            row[at["Feedback comments"]],
        )
        for row in rows[1:]
    }


HALF = make_outcome(make_grade("team-1", share=0.5, flags=(hertz_flag(),)), owner="doejane (1024)")
FULL = make_outcome(make_grade("team-2", authors=("=ann", "bo")), owner="poeann (1025)")
BROKEN = make_outcome(failed_grade("team-3", "<b>broken</b>"), owner="roeric (1026)")


def test_the_table_for_canvas_can_be_imported(tmp_path):
    """The table for Canvas has a row for each author; an ungraded author's cell is blank.

    A message names the ungraded submissions.
    """
    rows, remarks = write(tmp_path, HALF, FULL, BROKEN, platform="canvas", title="Lab 3 (77)")

    assert canvas_import(rows) == {
        "Lab 3 (77)": {"1024": "10", "'=ann": "20", "bo": "20", "1026": ""}
    }
    assert remarks[0] == "could not be graded, left blank: team-3"
    assert remarks[1].endswith("by the number in the file name: poeann (team-2)")


def test_a_broken_submission_graded_by_hand_is_exported(tmp_path):
    """A broken submission graded by hand is exported, even with 0 points."""
    rows, remarks = write(
        tmp_path, BROKEN, platform="canvas", overrides=[("team-3", "pieces", 0.0)]
    )
    assert canvas_import(rows) == {RUBRIC.title: {"1026": "0"}}
    assert remarks == ()


def test_a_submission_without_authors_is_named_in_a_message(tmp_path):
    """If a submission names no author, a message says that it is not exported."""
    nobody = make_outcome(failed_grade("team-8", "broken"))
    rows, remarks = write(tmp_path, FULL, nobody, platform="canvas")
    assert len(rows) == 4
    assert remarks[0] == "it names no author, so not exported: team-8"


def test_a_submission_whose_authors_are_not_read_yet_is_not_said_to_name_none(tmp_path):
    """If the grading ended before the authors were read, the message says that."""
    lost = failed_grade("team-8", "the cluster could not grade it")
    lost = make_outcome(lost.model_copy(update={"unsettled": True}), settled=False)
    _, remarks = write(tmp_path, FULL, lost, platform="canvas")
    assert remarks[0] == "its authors could not be read yet, so not exported: team-8"


@pytest.mark.parametrize("platform", ["canvas", "moodle", "gradescope"])
def test_a_number_of_another_platform_is_ignored(tmp_path, platform):
    """A student's number on another platform is ignored, since here it may be somebody else's."""
    others = {"canvas", "moodle", "gradescope"} - {platform}
    entries = [
        make_outcome(make_grade(f"team-{of}"), owner=f"Jane Doe ({of} 1024)") for of in others
    ]
    rows, _ = write(tmp_path, *entries, platform=platform)
    assert not any("1024" in cell for row in rows for cell in row)
    (tmp_path / "own").mkdir()
    rows, _ = write(
        tmp_path / "own", make_outcome(make_grade("t"), owner=f"Jane ({platform} 1024)"),
        platform=platform,
    )  # fmt: skip
    assert any("1024" in cell for row in rows for cell in row)


def test_a_canvas_roster_is_filled_in(tmp_path):
    """A Canvas roster is filled in by id, login or name; rows of other students stay unchanged.

    The column is found by the assignment's title.
    """
    roster = (
        "Student,ID,SIS User ID,SIS Login ID,Section,Lab 3 (77),Final Score\n"
        "    Points Possible,,,,,20,(read only)\n"
        '"Doe, Jane",1024,u1,jane@x.edu,A,3,90\n'
        '"Lee, Bo",7,u2,bo@x.edu,A,,80\n'
        '"Poe, Ann",8,=ann,ap@x.edu,B,,70\n'
        '"Zed, Al",9,u9,al@x.edu,B,5,60\n'
    )
    rows, remarks = write(
        tmp_path, HALF, FULL, BROKEN, platform="canvas", title="Lab 3", roster=roster
    )
    assert canvas_import(rows) == {"Lab 3 (77)": {"1024": "10", "7": "20", "8": "20", "9": "5"}}
    assert remarks[1] == "replaced in roster.csv: Doe, Jane (3 → 10)"
    assert remarks[-2:] == (
        "not in roster.csv, so not exported: roeric",
        "no grade from cartlab, so roster.csv keeps its own: Zed, Al (5)",
    )


def test_a_grade_typed_by_hand_is_kept_if_cartlab_has_none(tmp_path):
    """A submission that could not be graded keeps the roster's grade and comment."""
    roster = "Student,ID,Section,Lab 3 (77)\n    Points Possible,,,20\nRoe Eric,1026,A,17\n"
    rows, remarks = write(tmp_path, BROKEN, platform="canvas", title="Lab 3", roster=roster)
    assert rows[-1][-1] == "17"
    assert remarks == (
        "could not be graded, left as it was: team-3",
        "no grade from cartlab, so roster.csv keeps its own: Roe Eric (17)",
    )


@pytest.mark.parametrize("login", ["a1", "A1", " a1 ", "a1\u00a0", "a1@uni.example"])
@pytest.mark.parametrize("column", ["SIS User ID", "SIS Login ID"])
def test_spaces_and_case_of_an_id_do_not_matter(tmp_path, login, column):
    """An id in a roster is found with other spaces and other capitals."""
    team = make_outcome(make_grade("t", authors=("a1",)))
    roster = f'Student,ID,{column},Section,Lab 3\n"B, A",,{login},S1,\n'
    rows, _ = write(tmp_path, team, platform="canvas", title="Lab 3", roster=roster)
    assert rows[-1][-1] == "20"


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_a_name_is_found_in_every_unicode_form(tmp_path, form):
    """Composed and decomposed accents are the same name."""
    name = unicodedata.normalize(form, "Müller, Zoë")
    team = make_outcome(make_grade("t", authors=("x",)), owner="müllerzoë (canvas 1024)")
    roster = f'Student,ID,SIS Login ID,Section,Lab 3\n"{name}",,zz,S1,\n'
    rows, _ = write(tmp_path, team, platform="canvas", title="Lab 3", roster=roster)
    assert rows[-1][-1] == "20"


@pytest.mark.parametrize(
    ("title", "warned"), [("Final Score", True), ("Finals", False), ("Lab 3 (final)", True)]
)
def test_a_title_that_canvas_may_skip_is_named(tmp_path, title, warned):
    """A title with a word of Canvas' own columns gets a message."""
    _, remarks = write(tmp_path, HALF, platform="canvas", title=title)
    assert any("the title contains" in text for text in remarks) == warned


def test_an_author_twice_in_a_roster_is_named_in_a_message(tmp_path):
    """If two rows of a roster match an author, neither changes, and a message says why."""
    roster = (
        "Student,ID,SIS User ID,SIS Login ID,Section,Lab 3\n"
        "    Points Possible,,,,,20\n"
        '"Doe, Jane",1024,u1,jane@x.edu,A,\n'
        '"Lee, Bo",7,u2,bo@x.edu,A,\n"Lee, Bo",8,u2,bo@x.edu,A,\n'
    )
    rows, remarks = write(tmp_path, HALF, FULL, platform="canvas", title="Lab 3", roster=roster)
    assert canvas_import(rows) == {"Lab 3": {"1024": "10", "7": "", "8": ""}}
    assert remarks[0] == "in several rows of roster.csv, so not exported: bo"
    assert not any("not in roster.csv, so not exported: bo" in remark for remark in remarks)


def test_moodle_gets_a_worksheet_if_participants_are_known(tmp_path):
    """If participant numbers are known, Moodle gets a worksheet with feedback as safe HTML."""
    rows, _ = write(tmp_path, HALF, BROKEN, platform="moodle")

    found = moodle_import(rows)
    assert {number: grade for number, (grade, _) in found.items()} == {"1024": "10", "1026": ""}
    assert "this looks like Hz where rad/s is asked." in found["1024"][1]
    assert found["1026"][1] == "Could not be graded: &lt;b&gt;broken&lt;/b&gt;"
    assert all(row[rows[0].index("Maximum Grade")] == "20" for row in rows[1:])


def test_a_moodle_worksheet_is_filled_in(tmp_path):
    """A Moodle worksheet is filled in by participant, id number or email.

    Every other cell stays unchanged.
    """
    roster = (
        "Identifier,Full name,ID number,Email address,Status,Grade,Maximum Grade,"
        "Grade can be changed,Last modified (submission),Last modified (grade),Feedback comments\n"
        'Participant 1024,Jane Doe,,j@x.edu,Submitted,,20.00,Yes,"Friday, 3 May",-,\n'
        "Participant 5,Bo Lee,,bo@x.edu,Submitted,,20.00,Yes,-,-,\n"
        "Participant 6,Al Zed,,al@x.edu,No submission,,20.00,Yes,-,-,kept\n"
    )
    rows, remarks = write(tmp_path, HALF, FULL, platform="moodle", roster=roster)
    found = moodle_import(rows)
    assert {k: g for k, (g, _) in found.items()} == {"1024": "10", "5": "20", "6": ""}
    assert found["6"][1] == "kept"
    assert rows[1][8:10] == ["Friday, 3 May", "-"]
    assert remarks == ("not in roster.csv, so not exported: =ann",)


WORKSHEETS = {  # heading, participant, status, yes
    "German": (
        'ID,"Vollständiger Name",E-Mail-Adresse,Status,Bewertung,Bestwertung,"Bewertung kann '
        'geändert werden","Zuletzt geändert (Abgabe)","Zuletzt geändert (Bewertung)","Feedback als '
        'Kommentar"',
        "Teilnehmer/in{}", "Zur Bewertung abgegeben", "Ja",
    ),
    "French": (
        "Identifiant;Nom complet;Adresse de courriel;Statut;Note;Note maximale;La note peut être "
        "modifiée;Dernière modification (travail remis);Dernière modification (note);Feedback par "
        "commentaires",
        "Participant {}", "Remis pour évaluation", "Oui",
    ),
    "Japanese": (
        "ID,フルネーム,メールアドレス,ステータス,評点,最大評点,評点の変更可,最終更新日時 (提出),"
        "最終更新日時 (評点),フィードバックコメント",
        "参加者 {}", "評定のために提出済み", "Yes",
    ),
}  # fmt: skip


@pytest.mark.parametrize("language", WORKSHEETS)
@pytest.mark.parametrize("students", [1, 3])
def test_a_worksheet_in_any_language_is_filled_in(tmp_path, language, students):
    """A worksheet is recognised by its structure: points and comment are in the right columns."""
    head, participant, status, yes = WORKSHEETS[language]
    sep = ";" if ";" in head else ","
    people = [(1024, "Jane Doe", ""), (5, "Bo Lee", ""), (6, "Al Zed", "krank")][:students]
    lines = [
        sep.join(
            [participant.format(number), name, f"u{number}@x.edu", status, f'"{grade}"', '"20,00"',
             yes, "-", "-", ""]
        )
        for number, name, grade in people
    ]  # fmt: skip
    roster = "\n".join([head, *lines])
    rows, _ = write(tmp_path, HALF, platform="moodle", roster=roster)
    assert rows[0] == next(csv.reader([head], delimiter=sep))
    assert [row[4] for row in rows[1:]] == ["10", "", "krank"][:students]
    assert rows[1][5:9] == ["20,00", yes, "-", "-"]
    assert "Hz" in rows[1][9]


def test_a_gradebook_of_moodle_in_another_language_is_filled_in(tmp_path):
    """Without participants, students are found by email address or id number."""
    roster = (
        "Vorname,Nachname,ID-Nummer,E-Mail-Adresse,Aufgabe: Versuch 1 (Punkte)\n"
        "Bo,Lee,,bo@x.edu,-\nAl,Zed,u9,al@x.edu,3\n"
    )
    own = make_outcome(make_grade("t", authors=("U9",), share=0.5))
    rows, _ = write(tmp_path, FULL, own, platform="moodle", title="Lab 3", roster=roster)
    assert [row[4:] for row in rows[1:]] == [["-", "20"], ["3", "10"]]
    assert rows[0][5] == "Lab 3 (Real)"


@pytest.mark.parametrize(
    ("platform", "roster"),
    [
        ("moodle", "Identifier,Name,Status,Grade,Maximum Grade\nParticipant 1024,J Doe,-,,{}\n"),
        ("moodle", "Identifier,Name,Status,Grade,Maximum grade\nParticipant 1024,J Doe,-,,{}\n"),
        ("canvas", "Student,ID,Section,Lab 3 (7),L (8)\n Points Possible,,,{},4\nJ Doe,1024,A,,\n"),
    ],
)
def test_a_roster_with_another_maximum_is_refused(tmp_path, platform, roster):
    """A roster with a different maximum is refused, since the platform would keep its own."""
    write(tmp_path, HALF, platform=platform, title="Lab 3", roster=roster.format('"20.00"'))
    with pytest.raises(ConfigError, match=r"maximum grade 18\.00, the rubric 20"):
        write(tmp_path, HALF, platform=platform, title="Lab 3", roster=roster.format("18.00"))


def test_moodle_gets_the_reason_for_points_by_hand(tmp_path):
    """The comment for Moodle says why points were given by hand, even for full points."""
    first = RUBRIC.criteria[0]
    given = [("team-b", first.id, first.points)]
    outcome = make_outcome(make_grade("team-b", share=0.0, authors=("bo",)))
    rows, _ = write(tmp_path, outcome, platform="moodle", overrides=given)
    assert "by hand from 0 to" in rows[1][2]


@pytest.mark.parametrize(("platform", "told"), [("moodle", 1), ("canvas", 0)])
def test_points_above_the_maximum_are_named_for_moodle(tmp_path, platform, told):
    """A bonus may exceed the maximum, which Moodle's import refuses and Canvas' does not."""
    more = make_grade("a", authors=("ann",)).model_copy(update={"points": RUBRIC.out_of + 1.5})
    _, said = write(tmp_path, make_outcome(more), platform=platform)
    named = [text for text in said if f"a ({RUBRIC.out_of + 1.5:g})" in text]
    assert len(named) == told


def test_moodle_gets_a_table_if_participants_are_unknown(tmp_path):
    """Without participant numbers, Moodle gets a table of grades by id number."""
    rows, _ = write(tmp_path, FULL, platform="moodle", title="Lab 3")
    assert rows == [
        ["ID number", "Lab 3 (Real)", "Lab 3 (Feedback)"],
        ["'=ann", "20", ""],
        ["bo", "20", ""],
    ]


def test_gradescope_gets_a_result_for_each_submission(tmp_path):
    """For Gradescope, each submission has a result that follows the autograder specification."""
    late = make_outcome(make_grade("team-4", share=0.5, days_late=1.25, deducted=1.0, points=9.0))
    rows, _ = write(tmp_path, HALF, FULL, BROKEN, late, platform="gradescope")

    head = rows[0]
    assert head[5:11] == [
        "Total Score", "Max Points", "Status", "Submission ID", "Submission Time",
        "Lateness (H:M:S)",
    ]  # fmt: skip
    assert [row[5] for row in rows[1:]] == ["10", "20", "20", "", "9"]
    assert [row[10] for row in rows[1:]][-1] == "30:00:00"
    results = {
        path.parent.name: json.loads(path.read_text(encoding="utf-8"))
        for path in (tmp_path / "out" / "gradescope").glob("*/results.json")
    }
    assert sorted(results) == ["team-1", "team-2", "team-3", "team-4"]
    top = {"score", "output", "output_format", "test_output_format", "test_name_format",
           "stdout_visibility", "tests", "extra_data"}  # fmt: skip
    inner = {"score", "max_score", "status", "name", "number", "output", "tags", "visibility"}
    for result in results.values():
        assert set(result) == top
        assert all(set(test) == inner for test in result["tests"])
        assert {test["status"] for test in result["tests"]} <= {"passed", "failed"}
    assert results["team-4"]["score"] == 9.0
    assert sum(test["max_score"] for test in results["team-1"]["tests"]) == 20.0
    assert results["team-1"]["extra_data"] == {"flags": ["hz_for_rad_s"]}


@pytest.mark.parametrize("platform", ["canvas", "moodle", "gradescope"])
@pytest.mark.parametrize("author", ["s-team-1", " S-Team-1"])
def test_different_points_in_two_submissions_are_not_exported(tmp_path, platform, author):
    """If an author's two submissions have different points, no points are exported for the author.

    A message names both submissions, so that the instructor can remove the wrong one.
    """
    other = make_outcome(make_grade("team-9", share=0.25, authors=(author,)))
    rows, remarks = write(tmp_path, HALF, other, platform=platform)
    assert not [cell for row in rows for cell in row if re.search(r"^(10|5)$|omega_1", cell)]
    assert remarks == (
        "s-team-1 is in team-1 (10) and team-9 (5): left out until the "
        "wrong one is removed with cartlab remove",
    )


def test_equal_points_in_two_submissions_are_exported(tmp_path):
    """If an author's two submissions have the same points, the author gets these points."""
    other = make_outcome(make_grade("team-9", share=0.5, authors=("s-team-1",)))
    rows, remarks = write(tmp_path, HALF, other, platform="canvas")
    assert (canvas_import(rows), remarks) == ({RUBRIC.title: {"1024": "10"}}, ())


def test_a_row_that_two_submissions_match_is_unchanged(tmp_path):
    """If one submission matches a row by author and another by uploader, the row is unchanged."""
    roster = 'Student,ID,SIS User ID,SIS Login ID,Section,Lab 3\n"Doe, Jane",1001,S1,jane,A,3\n'
    by_id = make_outcome(make_grade("team-1", share=0.5, authors=("s1",)))
    by_number = make_outcome(make_grade("o", authors=("x", "y")), owner="doejane (canvas 1001)")
    for order in (1, -1):
        (tmp_path / f"{order}").mkdir()
        rows, remarks = write(
            tmp_path / f"{order}", *[by_id, by_number][::order],
            platform="canvas", title="Lab 3", roster=roster,
        )  # fmt: skip
        assert canvas_import(rows) == {"Lab 3": {"1001": "3"}}
        assert [r for r in remarks if "team-1 (10)" in r and "o (20)" in r and "left out" in r]


def test_an_upload_does_not_decide_between_two_submissions(tmp_path):
    """If an author is in two submissions, no points are exported, even if the author uploaded one.

    One message names both submissions.
    """
    roster = 'Student,ID,SIS User ID,SIS Login ID,Section,Lab 3\n"Doe, Jane",1001,s1,jane,A,3\n'
    one = make_outcome(make_grade("a", share=0.5, authors=("s1", "x")), owner="doejane (1001)")
    other = make_outcome(make_grade("b", share=0.25, authors=("s1",)))
    rows, remarks = write(tmp_path, one, other, platform="canvas", title="Lab 3", roster=roster)
    assert canvas_import(rows) == {"Lab 3": {"1001": "3"}}
    assert [r for r in remarks if "left out" in r] == [
        "s1 is in a (10) and b (5): left out until the wrong one is removed with cartlab remove"
    ]


@pytest.mark.parametrize("own", [False, True])
def test_an_author_is_named_if_the_uploader_got_the_points(tmp_path, own):
    """If another student uploads an author's work and gets the points, a message names the author.

    The uploader's number takes precedence over the authors' ids. If `own` is true, the author also
    has an ungraded submission.
    """
    roster = 'Student,ID,SIS User ID,Section,Lab 3\n"Doe, Jane",1001,s1,A,\n"Roe, Jo",1002,s2,A,\n'
    broken = failed_grade("a", "no TOML").model_copy(update={"authors": ("s1",)})
    outcomes = [make_outcome(broken, owner="doejane (canvas 1001)")] * own
    outcomes.append(
        make_outcome(make_grade("b", share=0.5, authors=("s1",)), owner="roejo (canvas 1002)")
    )
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
        book.finish(Batch(keys=tuple(o.key for o in outcomes), shared={}), rubric=RUBRIC)
        (tmp_path / "roster.csv").write_text(roster, encoding="utf-8")
        done = export(
            book, "canvas", tmp_path / "out", title="Lab 3", roster=tmp_path / "roster.csv"
        )
    (remark,) = [remark for remark in done.remarks if remark.left_out]
    assert remark.text == (
        "given no points, because another account submitted and received them: s1 (b)"
    )


@pytest.mark.parametrize("platform", ["canvas", "moodle", "gradescope"])
def test_points_by_hand_of_a_submission_without_names_are_exported(tmp_path, platform):
    """If a submission names nobody, points given by hand are exported under its folder's name.

    If an earlier version of the submission named authors, the authors get the points.
    """
    broken = make_outcome(failed_grade("team-8", "no TOML"))
    rows, remarks = write(
        tmp_path, broken, platform=platform, overrides=[("team-8", "pieces", 0.75)]
    )
    (row,) = [row for row in rows if "team-8" in row]
    assert "0.75" in row
    assert remarks == ("it names no author, so exported under the name of its folder: team-8",)

    outcomes = make_outcome(make_grade("team-8"), key="1"), replace(broken, key="2")
    (tmp_path / "again").mkdir()
    with Gradebook(tmp_path / "again", assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
            book.finish(Batch(keys=(outcome.key,), shared={}), rubric=RUBRIC)
        book.override("team-8", "pieces", 0.75, why="x", by="y")
        (student,), remarks = students_of(list(book.entries()), platform="canvas")
    assert (student.id, student.points, remarks) == ("s-team-8", "0.75", [])


def test_the_author_who_uploaded_is_found_by_number(tmp_path):
    """If Canvas knows no author's id, the number in the file's name decides who gets the points.

    The other authors are named in a message.
    """
    roster = 'Student,ID,SIS User ID,SIS Login ID,Section\n"Doe, Jane",1001,S1,doejane,A\n'
    team = make_outcome(make_grade("t", authors=("u1a", "u1b")), owner="doejane (canvas 1001)")
    other = make_outcome(make_grade("o", authors=("x", "y")), owner="roeric (canvas 9)")
    rows, remarks = write(tmp_path, team, other, platform="canvas", roster=roster)
    assert canvas_import(rows) == {RUBRIC.title: {"1001": "20"}}
    assert remarks[:2] == (
        "not in roster.csv, so not exported: u1a, u1b, x, y",
        "none of these is in roster.csv: o",
    )
    assert remarks[2].endswith("one of the authors: doejane (t)")


@pytest.mark.parametrize(
    ("platform", "head", "wanted"),
    [
        ("canvas", "a,b", "ID and Student"),
        ("moodle", "Student,ID,SIS User ID,SIS Login ID,Section", "Identifier, or ID number"),
        ("gradescope", "Identifier,Full name,Email address", "SID, or Email"),
        ("canvas", "First Name,Last Name,SID,Email", "ID and Student"),
    ],
)
def test_a_table_that_is_not_a_roster_is_refused(tmp_path, platform, head, wanted):
    """A table that is not a roster of the platform is refused; the message names the columns."""
    with pytest.raises(
        ConfigError, match=rf"roster\.csv: is not {platform.capitalize()}.*{wanted}"
    ):
        write(tmp_path, HALF, platform=platform, roster=f"{head}\n1,2,3\n")


def test_a_roster_with_two_columns_of_one_name_is_refused(tmp_path):
    """A roster with two columns of the same name is refused, unless the columns have no name."""
    with pytest.raises(ConfigError, match=r"roster\.csv: has two columns 'Lab'"):
        write(tmp_path, HALF, platform="canvas", roster="Student,ID,Lab,Lab\na,1,,\n")
    rows, _ = write(tmp_path, HALF, platform="gradescope", roster="SID,,Name,\ns-team-1,x,y,z\n")
    assert rows == [["SID", "", "Name", "", "Total Score", "Max Points"],
                    ["s-team-1", "x", "y", "z", "10", "20"]]  # fmt: skip


def test_gradescope_gets_0_for_an_ungraded_submission(tmp_path):
    """Gradescope gets 0 for an ungraded submission, and a message says so."""
    _, remarks = write(tmp_path, BROKEN, platform="gradescope")
    (path,) = (tmp_path / "out" / "gradescope").glob("*/results.json")
    assert json.loads(path.read_text("utf-8"))["score"] == 0
    assert "but 0 in results.json" in remarks[0]


@pytest.mark.parametrize("platform", ["moodle", "gradescope"])
def test_no_comment_names_the_other_team(tmp_path, platform):
    """A comment on a shared recording says that another submission has it, but not which one."""
    shared = make_outcome(make_grade("a", flags=(shared_flag("b-team"),)), owner="Ann (1024)")
    write(tmp_path, shared, platform=platform)
    texts = [path.read_text("utf-8") for path in (tmp_path / "out").rglob("*.*")]
    said = [text for text in texts if "step-1 is also in another submission" in text]
    assert said
    assert not any("b-team" in text for text in texts)


def test_a_comment_says_that_a_stopped_submission_is_graded_again(tmp_path):
    """If a limit ended the grading, the comment on the platform says what the staff will do."""
    stopped = failed_grade("team-8", "stopped after 120 s")
    changes = {"unsettled": True, "authors": ("s8",)}
    stopped = make_outcome(stopped.model_copy(update=changes), settled=False)
    rows, _ = write(tmp_path, FULL, stopped, platform="moodle")
    said = str(rows)
    assert "Could not be graded yet: stopped after 120 s. As far as we know" in said
