"""The zip of feedback files follows the rules of each platform's importer."""

import io
import re
import zipfile
from pathlib import Path, PurePosixPath

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.platforms import PLATFORMS, Account, parse_name
from pipeline.grading.publish.export import export_feedback, remove_exports
from tests.helpers.grades import (
    book_of,
    failed_grade,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

WORKSHEET = (
    "Identifier,Full name,ID number,Email address,Status,Grade,Maximum Grade\n"
    "Participant 1024,Jane Doe,s1,j@x.edu,-,,20\nParticipant 77,Bo Lee,bo,bo@x.edu,-,,20\n"
    "Participant 78,Al Zed,al,al@x.edu,-,,20\n"
)


def sent(name: str, *authors: str, owner: str = "", grade=None, **changes):
    """Return a graded submission that an account handed in."""
    grade = grade or make_grade(name, share=0.5, authors=authors, **changes)
    return make_outcome(grade, owner=owner)


def canvas(file: str) -> str:
    """Return the owner of a file in a download of Canvas, as the gradebook keeps it."""
    upload = parse_name(file)
    assert upload is not None
    return str(Account.of({Path(file): upload}, name=upload.owner))


def write(tmp_path, *class_, platform: str, rubric=None, roster: str = "", shared=None):
    """Export the feedback of a class; return the files in the zip and the remarks."""
    if roster:
        (tmp_path / "roster.csv").write_text(roster, encoding="utf-8-sig")
    where = tmp_path / "roster.csv" if roster else None
    with book_of(tmp_path / "g.sqlite", *class_, rubric=rubric, shared=shared) as book:
        done = export_feedback(book, PLATFORMS[platform], tmp_path / "out", roster=where)
    (file,) = done.files
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}, done.remarks


def canvas_import(paths) -> dict[tuple[str, str], str]:
    """Return each file by user and attachment, by the rules of Canvas.

    See `infer_comment_context_from_filename` in its `abstract_assignment.rb`.
    """
    found = {}
    for path in paths:
        name = PurePosixPath(path).name
        parts = [part for part in name.split("_") if part != "LATE"]
        if parts[0] == "anon":
            user, attachment = parts[1:3]
        else:
            user, attachment = [part for part in parts if re.fullmatch(r"\d+", part)][:2]
        assert not re.match("link", parts[-1])
        assert not name.startswith("._")
        found[user, attachment] = path
    return found


def moodle_import(paths) -> dict[int, str]:
    """Return the stored name of each file by participant, by the rules of Moodle.

    See `is_valid_filename_for_import` in its `importziplib.php`.
    """
    found = {}
    for path in paths:
        folder, name = path.split("/")
        assert name[0] not in ".~"
        _, participant, subtype, plugin, rest = folder.split("_", 4)
        assert (subtype, plugin, rest) == ("assignsubmission", "file", "")
        assert int(participant) not in found
        found[int(participant)] = name
    return found


def page_of(content: bytes) -> str:
    """Return the page in a file, which may be a zip."""
    if content[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(content)) as inner:
            assert inner.namelist() == ["feedback.html"]
            content = inner.read("feedback.html")
    return content.decode()


def test_canvas_gets_the_names_of_its_download(tmp_path):
    """Each file has the name that Canvas gave to the upload; a zip is answered with a zip.

    One file serves a team. A submission whose upload is not known is named.
    """
    files, remarks = write(
        tmp_path,
        sent("team-1", "s1", "s2", owner=canvas("doejane_LATE_1024_77001_lab3.zip")),
        sent("team-2", "bo", owner=canvas("leebo_1025_77002_submission.toml")),
        sent("anon", "al", owner=canvas("LATE_anon_x7Yb2_77006_linkage.zip")),
        sent("old", "ed", owner="zedal (canvas 1030)"),
        make_outcome(failed_grade("x", "no TOML"), owner=canvas("roe_1031_77009_x.zip")),
        platform="canvas",
    )
    found = canvas_import(files)
    assert set(found) == {("1024", "77001"), ("1025", "77002"), ("x7Yb2", "77006"),
                          ("1031", "77009")}  # fmt: skip
    assert "doejane_LATE_1024_77001_lab3.zip" in files
    pages = {key: page_of(files[path]) for key, path in found.items()}
    assert "team-1" in pages["1024", "77001"]
    assert "o TOML" in pages["1031", "77009"]
    assert files[found["1025", "77002"]].startswith(b"<!")
    about = [remark.text.rpartition(": ")[2] for remark in remarks]
    assert about == ["ed", "leebo_1025_77002_submission.toml"]
    assert [remark.left_out for remark in remarks] == [True, False]


def test_moodle_gets_a_folder_for_each_participant(tmp_path):
    """The worksheet gives the numbers of all authors, whatever the number of the download.

    The number of a group's download may be that of another student, who must not get the page.
    """
    class_ = (
        sent("t", "s1", "al", owner="Team_1 (moodle 77)"),
        sent("u", "nobody", owner="Group 9 (moodle 77)"),
        sent("v", "bo", owner="Bo Lee (moodle 77)"),
    )
    files, remarks = write(tmp_path, *class_, platform="moodle", roster=WORKSHEET)
    assert moodle_import(files) == dict.fromkeys((1024, 78, 77), "feedback.html")
    named = {path.split("_")[1]: re.findall("<h1[^>]*>(.*?)</h1>", page_of(raw))
             for path, raw in files.items()}  # fmt: skip
    assert {key: found[0].strip() for key, found in named.items()} == {
        "1024": "t", "78": "t", "77": "v",
    }  # fmt: skip
    assert [remark.text.rpartition(": ")[2] for remark in remarks] == ["nobody"]


def test_moodle_without_a_worksheet_takes_the_numbers_of_the_download(tmp_path):
    """The account that submitted gets the page; a remark says so, because it may be a group.

    If nothing is known of a submission's accounts, its authors are named.
    """
    class_ = (
        sent("a", "s1", owner="Jane Doe (moodle 1024)"),
        sent("b", "x", "y", owner="Bo Lee (moodle 7)"),
        sent("c", "z", "w"),
    )
    files, (guessed, lost) = write(tmp_path, *class_, platform="moodle")
    assert set(files) == {
        "Jane Doe_1024_assignsubmission_file_/feedback.html",
        "Bo Lee_7_assignsubmission_file_/feedback.html",
    }
    assert guessed.text.endswith(": Jane Doe (a), Bo Lee (b)")
    assert lost.text.endswith(": z, w")
    assert [guessed.left_out, lost.left_out] == [False, True]
    assert all("--roster" in remark.text for remark in (guessed, lost))


ODD = ["../../etc/passwd", "..", ".", "~", "a_b_7_c", "C:\\x", "Ünal 学生", "\u202egnp.exe", "/",
       "Jane", "jane", "x" * 300, "\n\r", "nul", ""]  # fmt: skip


def test_odd_names_neither_leave_the_zip_nor_collide(tmp_path):
    """Whatever a student's name is, each has a folder of their own in the zip."""
    class_ = [
        sent(f"t{n}", f"s{n}", owner=f"{name} (moodle {1000 + n})") for n, name in enumerate(ODD)
    ]
    files, remarks = write(tmp_path, *class_, platform="moodle")
    assert len(remarks) == 1  # these may be groups
    assert set(moodle_import(files)) == {1000 + n for n in range(len(ODD))}
    folders = [path.split("/")[0] for path in files]
    assert len({folder.casefold() for folder in folders}) == len(ODD)
    for folder in folders:
        assert folder.isprintable()
        assert not re.search(r'[<>:"\\|?*]|^[.~ ]|[. ]$', folder)
        assert len(folder) < 200


@pytest.mark.parametrize(
    "name",
    [
        "Bob (gradescope 7: x",
        "Bob (7)",
        "Bob (moodle 7) Roe",
        "Jane (she) Doe",
        "B (anonymous: x",
    ],
)
@pytest.mark.parametrize("number", ["77001", ""])
def test_no_name_claims_the_number_of_another_account(name, number):
    """A displayed name may look like an account of the gradebook; only the real number counts."""
    text = str(Account(name=name, platform="gradescope", number=number))
    assert Account.read(text).number == number
    assert Account.read(text).name.replace("[", "(") == name


def test_two_submissions_of_one_file_name_are_named(tmp_path):
    """If two submissions have the same downloaded name, one file is written and the other named."""
    owner = canvas("doejane_1024_77001_lab3.zip")
    files, remarks = write(
        tmp_path, sent("a", "s1", owner=owner), sent("b", "s2", owner=owner), platform="canvas"
    )
    assert len(files) == 1
    assert [remark.left_out for remark in remarks] == [True]


@pytest.mark.parametrize("anonymous", [False, True])
def test_a_page_without_numbers(tmp_path, anonymous):
    """With `see = "check"`, a page has points, titles and a person's words, but no computed number.

    No page names another team.
    """
    rubric = two_cart_rubric()
    students = rubric.students.model_copy(update={"see": "check"})
    hidden = rubric.model_copy(update={"students": students, "anonymous": anonymous})
    secrets = ("19.6", "3.12", "6283", "7.77")
    grade = make_grade(
        "a", share=0.5, flags=(hertz_flag(),), authors=("s1",), notes=("K_1 is 6283.",)
    )
    drawn = (("response-1.svg", "<svg><title>7.77</title></svg>"),)
    class_ = make_outcome(grade, owner="Jane (moodle 7)", figures=drawn), sent("b-team", "s2")
    texts = {}
    for name, asked in (("open", rubric), ("hidden", hidden)):
        place = tmp_path / name
        place.mkdir()
        shared = {"a": shared_flag("b-team")}
        files, _ = write(place, *class_, platform="moodle", rubric=asked, shared=shared)
        page = page_of(files["Jane_7_assignsubmission_file_/feedback.html"])
        texts[name] = re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL)
    assert all(secret in texts["open"] for secret in secrets)
    assert not any(secret in texts["hidden"] for secret in secrets)
    assert "10 of 20" in texts["hidden"]
    assert "Hz where rad/s" in texts["hidden"]
    assert not any("b-team" in text for text in texts.values())


def test_the_same_class_gives_the_same_bytes(tmp_path):
    """The zip does not depend on the time; erasing submissions removes it."""
    made = []
    for name in ("first", "second"):
        place = tmp_path / name
        place.mkdir()
        owner = canvas("doejane_1024_77001_lab3.zip")
        write(place, sent("a", "s1", owner=owner), platform="canvas")
        made.append((place / "out" / "feedback-canvas.zip").read_bytes())
    assert made[0] == made[1]
    assert [path.name for path in remove_exports(place / "out")] == ["feedback-canvas.zip"]


def test_what_cannot_be_sent_is_refused(tmp_path):
    """Gradescope takes no such zip, and a class of unknown accounts gives none."""
    for platform, words in (("gradescope", "canvas or moodle"), ("moodle", "--roster")):
        (tmp_path / platform).mkdir()
        with pytest.raises(ConfigError, match=words):
            write(tmp_path / platform, sent("a", "s1"), platform=platform)
    assert not list(tmp_path.rglob("*.zip"))
