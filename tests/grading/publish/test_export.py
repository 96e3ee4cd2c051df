"""Exported files follow the rules of each platform's importer."""

import csv
import io
import json
import re
import unicodedata
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export
from pipeline.grading.publish.roster import students_of
from tests.helpers.grades import (
    book_of,
    failed_grade,
    finish,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

RUBRIC = two_cart_rubric()
HALF = make_outcome(make_grade("team-1", share=0.5, flags=(hertz_flag(),)), owner="doejane (1024)")
FULL = make_outcome(make_grade("team-2", authors=("=ann", "bo")), owner="poeann (1025)")
BROKEN = make_outcome(failed_grade("team-3", "<b>broken</b>"), owner="roeric (1026)")
NOBODY = make_outcome(failed_grade("team-8", "no TOML"), key="nobody")


def team(name: str, *authors: str, share: float = 1.0, owner: str = ""):
    """Return a graded team that some account submitted."""
    return make_outcome(make_grade(name, share=share, authors=authors), owner=owner)


def stopped(*authors: str):
    """Return a submission whose grading was ended by a limit."""
    grade = failed_grade("team-8", "stopped after 120 s")
    changes = {"unsettled": True, "authors": authors}
    return make_outcome(grade.model_copy(update=changes), settled=False)


def write(tmp_path: Path, *outcomes, platform, roster: str = "", overrides=(), **options):
    """Export a class; return the rows of the exported table and the remarks."""
    with book_of(tmp_path / "g.sqlite", *outcomes) as book:
        for name, points in overrides:
            book.override(name, "pieces", points, why="x", by="y")
        if roster:
            (tmp_path / "roster.csv").write_text(roster, encoding="utf-8-sig")
            options["roster"] = tmp_path / "roster.csv"
        done = export(book, PLATFORMS[platform], tmp_path / "out", **options)
    text = done.files[0].read_bytes().decode()
    return list(csv.reader(io.StringIO(text, newline=""))), done.remarks


def named(remarks, *, left_out=None) -> list[str]:
    """Return whom each remark names: what follows its colon."""
    return [
        remark.text.rpartition(": ")[2]
        for remark in remarks
        if left_out is None or remark.left_out == left_out
    ]


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


# ------------------------------------------------------------------- tables without a roster


@pytest.mark.parametrize(
    ("class_", "overrides", "cells", "about"),
    [
        # an ungraded author's cell is blank; a number on Canvas belongs to one author of a team
        ((HALF, FULL, BROKEN), [], {"1024": "10", "'=ann": "20", "bo": "20", "1026": ""},
         ["team-3", "poeann (team-2)"]),
        ((BROKEN,), [("team-3", 0.0)], {"1026": "0"}, []),  # graded by hand
        ((FULL, NOBODY), [], {"'=ann": "20", "bo": "20"}, ["team-8", "poeann (team-2)"]),
        ((FULL, stopped()), [], {"'=ann": "20", "bo": "20"}, ["team-8", "poeann (team-2)"]),
        ((NOBODY,), [("team-8", 0.75)], {"team-8": "0.75"}, ["team-8"]),
        ((HALF, team("t", "s-team-1", share=0.5)), [], {"1024": "10"}, []),  # the same points
    ],
)  # fmt: skip
def test_canvas_gets_a_row_for_each_author(tmp_path, class_, overrides, cells, about):
    """Each author has a row with the points; remarks name the submissions without a grade."""
    rows, remarks = write(
        tmp_path, *class_, platform="canvas", title="Lab 3 (77)", overrides=overrides
    )
    assert canvas_import(rows) == {"Lab 3 (77)": cells}
    assert named(remarks) == about
    assert not any(remark.left_out for remark in remarks)


def test_unread_authors_are_not_missing_authors(tmp_path):
    """The remark tells authors that could not be read yet from authors that are not named."""
    said = {write(tmp_path, one, platform="canvas")[1][0].text for one in (stopped(), NOBODY)}
    assert len(said) == 2


@pytest.mark.parametrize("platform", PLATFORMS)
def test_a_number_of_another_platform_is_ignored(tmp_path, platform):
    """A student's number on another platform is ignored, since here it may be somebody else's."""
    others = [
        team(f"team-{of}", "s", owner=f"Jane ({of} 1024)") for of in PLATFORMS if of != platform
    ]
    rows, _ = write(tmp_path, *others, platform=platform)
    assert not any("1024" in cell for row in rows for cell in row)
    rows, _ = write(tmp_path, team("t", "s", owner=f"Jane ({platform} 1024)"), platform=platform)
    assert any("1024" in cell for row in rows for cell in row)


def test_0_points_count_more_than_no_grade(tmp_path):
    """If an author has an ungraded submission and one with 0 points, the 0 points are exported."""
    unread = failed_grade("a", "too slow").model_copy(update={"authors": ("bob",)})
    with book_of(tmp_path, unread, make_grade("b", share=0.0, authors=("bob",))) as book:
        for order in (1, -1):
            (bob,), _ = students_of(list(book.entries())[::order], platform=PLATFORMS["canvas"])
            assert (bob.grade.submission, bob.points) == ("b", "0")


def test_points_by_hand_go_to_the_authors_of_an_earlier_version(tmp_path):
    """If an earlier version of a submission named authors, they get points given by hand."""
    with book_of(tmp_path, make_grade("team-8")) as book:
        finish(book, NOBODY)
        book.override("team-8", "pieces", 0.75, why="x", by="y")
        (student,), remarks = students_of(list(book.entries()), platform=PLATFORMS["canvas"])
    assert (student.id, student.points, remarks) == ("s-team-8", "0.75", [])


@pytest.mark.parametrize("platform", PLATFORMS)
def test_points_by_hand_of_a_submission_without_names_are_exported(tmp_path, platform):
    """If a submission names nobody, points by hand are exported under its folder's name."""
    rows, remarks = write(tmp_path, NOBODY, platform=platform, overrides=[("team-8", 0.75)])
    (row,) = [row for row in rows if "team-8" in row]
    assert "0.75" in row
    assert named(remarks, left_out=False) == ["team-8"]


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("author", ["s-team-1", " S-Team-1"])
def test_different_points_in_two_submissions_are_not_exported(tmp_path, platform, author):
    """If an author's two submissions have different points, no points are exported for the author.

    A remark names both submissions, so that the instructor can remove the wrong one.
    """
    rows, remarks = write(tmp_path, HALF, team("team-9", author, share=0.25), platform=platform)
    assert not [cell for row in rows for cell in row if re.search(r"^(10|5)$|omega_1", cell)]
    (remark,) = remarks
    assert remark.left_out
    assert re.match(r"s-team-1 .*team-1 \(10\).*team-9 \(5\)", remark.text)


def test_moodle_gets_a_worksheet_if_participants_are_known(tmp_path):
    """If participant numbers are known, Moodle gets a worksheet with feedback as safe HTML."""
    rows, _ = write(tmp_path, HALF, BROKEN, platform="moodle")
    found = moodle_import(rows)
    assert {number: grade for number, (grade, _) in found.items()} == {"1024": "10", "1026": ""}
    assert hertz_flag().message.partition("this")[2] in found["1024"][1]
    assert found["1026"][1].endswith("&lt;b&gt;broken&lt;/b&gt;")
    assert all(row[rows[0].index("Maximum Grade")] == "20" for row in rows[1:])


def test_moodle_gets_a_table_if_participants_are_unknown(tmp_path):
    """Without participant numbers, Moodle gets a table of grades by id number."""
    rows, _ = write(tmp_path, FULL, platform="moodle", title="Lab 3")
    assert rows[0] == ["ID number", "Lab 3 (Real)", "Lab 3 (Feedback)"]
    assert rows[1:] == [["'=ann", "20", ""], ["bo", "20", ""]]


def test_moodle_gets_a_reason(tmp_path):
    """The comment says why points were given by hand, also full points, or what happens next."""
    overrides = [("team-b", 1.0)]
    given = team("team-b", "bo", share=0.0)
    rows, _ = write(tmp_path, given, stopped("s8"), platform="moodle", overrides=overrides)
    by_hand, waiting = rows[1][2], rows[2][2]
    assert "by hand" in by_hand
    assert re.search("yet: stopped.*120 s", waiting)


@pytest.mark.parametrize(("platform", "told"), [("moodle", 1), ("canvas", 0)])
def test_points_above_the_maximum_are_named_for_moodle(tmp_path, platform, told):
    """A bonus may exceed the maximum, which Moodle's import refuses and Canvas' does not."""
    more = make_grade("a", authors=("ann",)).model_copy(update={"points": RUBRIC.out_of + 1.5})
    _, remarks = write(tmp_path, more, platform=platform)
    assert named(remarks) == [f"a ({RUBRIC.out_of + 1.5:g})"] * told


def test_gradescope_gets_a_result_for_each_submission(tmp_path):
    """For Gradescope, each submission has a result that follows the autograder specification.

    An ungraded submission has 0 points there, and a remark names it.
    """
    late = make_grade("team-4", share=0.5, days_late=1.25, deducted=1.0, points=9.0)
    rows, remarks = write(tmp_path, HALF, FULL, BROKEN, late, platform="gradescope")
    assert rows[0][5:11] == [
        "Total Score", "Max Points", "Status", "Submission ID", "Submission Time",
        "Lateness (H:M:S)",
    ]  # fmt: skip
    assert [row[5] for row in rows[1:]] == ["10", "20", "20", "", "9"]
    assert rows[-1][10] == "30:00:00"
    results = {
        path.parent.name: json.loads(path.read_text(encoding="utf-8"))
        for path in (tmp_path / "out" / "gradescope").glob("*/results.json")
    }
    assert {name: result["score"] for name, result in results.items()} == {
        "team-1": 10, "team-2": 20, "team-3": 0, "team-4": 9,
    }  # fmt: skip
    assert named(remarks) == ["team-3"]
    top = {"score", "output", "output_format", "test_output_format", "test_name_format",
           "stdout_visibility", "tests", "extra_data"}  # fmt: skip
    inner = {"score", "max_score", "status", "name", "number", "output", "tags", "visibility"}
    for result in results.values():
        assert set(result) == top
        assert all(set(test) == inner for test in result["tests"])
        assert {test["status"] for test in result["tests"]} <= {"passed", "failed"}
    assert sum(test["max_score"] for test in results["team-1"]["tests"]) == 20.0
    assert results["team-1"]["extra_data"] == {"flags": ["hz_for_rad_s"]}


@pytest.mark.parametrize("platform", ["moodle", "gradescope"])
def test_no_comment_names_the_other_team(tmp_path, platform):
    """A comment on a shared recording says that another submission has it, but not which one."""
    shared = make_outcome(make_grade("a", flags=(shared_flag("b-team"),)), owner="Ann (1024)")
    write(tmp_path, shared, platform=platform)
    texts = [path.read_text("utf-8") for path in (tmp_path / "out").rglob("*.*")]
    assert any("another submission" in text for text in texts)
    assert not any("b-team" in text for text in texts)


@pytest.mark.parametrize("platform", PLATFORMS.values(), ids=PLATFORMS)
def test_no_export_for_students_has_a_number_that_they_must_find(tmp_path, platform):
    """With `see = "check"`, no comment or result contains a computed number."""
    students = RUBRIC.students.model_copy(update={"see": "check"})
    rubric = RUBRIC.model_copy(update={"students": students})
    with book_of(tmp_path / "g.sqlite", HALF, rubric=rubric) as book:
        export(book, platform, tmp_path / "out")
    texts = [path.read_text("utf-8") for path in (tmp_path / "out").rglob("*.*")]
    assert not any(number in text for text in texts for number in ("19.6", "3.12"))


# ------------------------------------------------------------------------------- rosters


HEAD = "Student,ID,SIS User ID,SIS Login ID,Section,Lab 3\n"
FILLED = {  # class, roster on Canvas, cells by number, whom the remarks name
    "by id, login or name": (
        (HALF, FULL, BROKEN),
        HEAD.replace("Lab 3", "Lab 3 (77),Final Score")
        + "    Points Possible,,,,,20,(read only)\n"
        '"Doe, Jane",1024,u1,jane@x.edu,A,3,90\n"Lee, Bo",7,u2,bo@x.edu,A,,80\n'
        '"Poe, Ann",8,=ann,ap@x.edu,B,,70\n"Zed, Al",9,u9,al@x.edu,B,5,60\n',
        {"1024": "10", "7": "20", "8": "20", "9": "5"},
        ["team-3", "Doe, Jane (3 → 10)", "roeric", "Zed, Al (5)"],
    ),
    "a grade typed by hand is kept if there is no other": (
        (BROKEN,),
        HEAD + "Roe Eric,1026,,,A,17\n",
        {"1026": "17"},
        ["team-3", "Roe Eric (17)"],
    ),
    "an author in two rows": (
        (HALF, FULL),
        HEAD + '"Doe, Jane",1024,u1,jane@x.edu,A,\n"Lee, Bo",7,u2,bo@x.edu,A,\n'
        '"Lee, Bo",8,u2,bo@x.edu,A,\n',
        {"1024": "10", "7": "", "8": ""},
        ["bo", "=ann", "team-2"],
    ),
    "an upload does not decide between two submissions": (
        (team("a", "s1", "x", share=0.5, owner="doejane (1001)"), team("b", "s1", share=0.25)),
        HEAD + '"Doe, Jane",1001,s1,jane,A,3\n',
        {"1001": "3"},
        None,
    ),
    "the author who uploaded is found by number": (
        (team("t", "u1a", "u1b", owner="doejane (canvas 1001)"),
         team("o", "x", "y", owner="roeric (canvas 9)")),
        HEAD + '"Doe, Jane",1001,S1,doejane,A,\n',
        {"1001": "20"},
        ["u1a, u1b, x, y", "o", "doejane (t)"],
    ),
    "another account submitted and received the points": (
        (team("b", "s1", share=0.5, owner="roejo (canvas 1002)"),),
        HEAD + '"Doe, Jane",1001,s1,,A,\n"Roe, Jo",1002,s2,,A,\n',
        {"1001": "", "1002": "10"},
        ["s1 (b)"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FILLED)
def test_a_canvas_roster_is_filled_in(tmp_path, case):
    """Students are found by number, id, login or name; all other rows stay as they are."""
    class_, roster, cells, about = FILLED[case]
    rows, remarks = write(tmp_path, *class_, platform="canvas", title="Lab 3", roster=roster)
    (grades,) = canvas_import(rows).values()
    assert grades == cells
    if about is None:
        remark = next(r.text for r in remarks if r.left_out and r.text.startswith("s1 "))
        assert "a (10)" in remark
        assert "b (5)" in remark
    else:
        assert [name for name in named(remarks) if name in about] == about
        assert len(remarks) == len(about)


@pytest.mark.parametrize("own", [False, True])
def test_an_author_is_named_if_the_uploader_got_the_points(tmp_path, own):
    """The uploader's number takes precedence over the authors' ids; the author is named.

    If `own` is true, the author also has an ungraded submission.
    """
    roster = 'Student,ID,SIS User ID,Section,Lab 3\n"Doe, Jane",1001,s1,A,\n"Roe, Jo",1002,s2,A,\n'
    broken = failed_grade("a", "no TOML").model_copy(update={"authors": ("s1",)})
    class_ = [make_outcome(broken, owner="doejane (canvas 1001)")] * own
    class_.append(team("b", "s1", share=0.5, owner="roejo (canvas 1002)"))
    _, remarks = write(tmp_path, *class_, platform="canvas", title="Lab 3", roster=roster)
    assert named(remarks, left_out=True) == ["s1 (b)"]


def test_a_row_that_two_submissions_match_is_unchanged(tmp_path):
    """If one submission matches a row by author and another by uploader, the row is unchanged."""
    roster = HEAD + '"Doe, Jane",1001,S1,jane,A,3\n'
    class_ = team("team-1", "s1", share=0.5), team("o", "x", "y", owner="doejane (canvas 1001)")
    for order in (1, -1):
        rows, remarks = write(
            tmp_path, *class_[::order], platform="canvas", title="Lab 3", roster=roster
        )
        assert canvas_import(rows) == {"Lab 3": {"1001": "3"}}
        assert [r for r in remarks if r.left_out and "team-1 (10)" in r.text and "o (20)" in r.text]


FOUND = [  # the row's id or name, and its column
    *((login, column) for login in ("a1", "A1", " a1 ", "a1\u00a0", "a1@uni.example")
      for column in ("SIS User ID", "SIS Login ID")),
    *((unicodedata.normalize(form, "Müller, Zoë"), "Student") for form in ("NFC", "NFD")),
]  # fmt: skip


@pytest.mark.parametrize(("typed", "column"), FOUND)
def test_a_row_is_found_however_its_text_is_written(tmp_path, typed, column):
    """An id is found with other spaces and capitals, a name in every form of its accents."""
    row = {"Student": "B, A", "ID": "", column: typed, "Section": "S1", "Lab 3": ""}
    roster = ",".join(row) + "\n" + ",".join(f'"{cell}"' for cell in row.values()) + "\n"
    own = team("t", "a1", owner="müllerzoë (canvas 1024)")
    rows, _ = write(tmp_path, own, platform="canvas", title="Lab 3", roster=roster)
    assert rows[-1][-1] == "20"


@pytest.mark.parametrize(
    ("title", "warned"), [("Final Score", True), ("Finals", False), ("Lab 3 (final)", True)]
)
def test_a_title_that_canvas_may_skip_is_named(tmp_path, title, warned):
    """A title with a word of Canvas' own columns gets a remark."""
    _, remarks = write(tmp_path, HALF, platform="canvas", title=title)
    assert (len(remarks) == 1) == warned


def test_a_moodle_worksheet_is_filled_in(tmp_path):
    """A Moodle worksheet is filled in by participant, id number or email; other cells stay."""
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
    assert named(remarks, left_out=True) == ["=ann"]


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
    rows, _ = write(tmp_path, HALF, platform="moodle", roster="\n".join([head, *lines]))
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
    own = team("t", "U9", share=0.5)
    rows, _ = write(tmp_path, FULL, own, platform="moodle", title="Lab 3", roster=roster)
    assert [row[4:] for row in rows] == [[roster.split(",")[4].split("\n")[0], "Lab 3 (Real)"],
                                         ["-", "20"], ["3", "10"]]  # fmt: skip


@pytest.mark.parametrize(
    ("platform", "roster"),
    [
        ("moodle", "Identifier,Name,Status,Grade,Maximum Grade\nParticipant 1024,J Doe,-,,{}\n"),
        ("moodle", "Identifier,Name,Status,Grade,Maximum grade\nParticipant 1024,J Doe,-,,{}\n"),
        ("canvas", "Student,ID,Section,Lab 3 (7),L (8)\n Points Possible,,,{},4\nJ Doe,1024,A,,\n"),
    ],
)
def test_a_roster_with_another_maximum_is_refused(tmp_path, platform, roster):
    """`check_maximum` refuses another maximum, since the platform would keep its own."""
    write(tmp_path, HALF, platform=platform, title="Lab 3", roster=roster.format('"20.00"'))
    for other in ("18.00", "100.00"):
        with pytest.raises(ConfigError, match=rf"{other}.* 20"):
            write(tmp_path, HALF, platform=platform, title="Lab 3", roster=roster.format(other))


@pytest.mark.parametrize(
    ("platform", "roster", "wanted"),
    [
        ("canvas", "a,b", "Canvas.*ID and"),
        ("canvas", "First Name,Last Name,SID,Email", "Canvas.*ID and"),
        ("canvas", "Student,ID,Lab,Lab", "columns 'Lab'"),
        ("moodle", "Student,ID,SIS User ID,SIS Login ID,Section", "Moodle.*Identifier"),
        ("gradescope", "Identifier,Full name,Email address", "Gradescope.*SID"),
    ],
)
def test_a_table_that_is_not_a_roster_is_refused(tmp_path, platform, roster, wanted):
    """A table that is not a roster of the platform is refused; the message names the columns."""
    with pytest.raises(ConfigError, match=rf"roster\.csv: .*{wanted}"):
        write(tmp_path, HALF, platform=platform, roster=f"{roster}\n1,2,3\n")


def test_columns_without_a_name_are_kept(tmp_path):
    """Two columns may both have no name."""
    rows, _ = write(tmp_path, HALF, platform="gradescope", roster="SID,,Name,\ns-team-1,x,y,z\n")
    assert rows == [["SID", "", "Name", "", "Total Score", "Max Points"],
                    ["s-team-1", "x", "y", "z", "10", "20"]]  # fmt: skip
