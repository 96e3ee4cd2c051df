"""Without scripts, the student's pages lead from uploaded files to the zip to hand in."""

import io
import json
import os
import re
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from html import escape, unescape
from pathlib import Path
from urllib.parse import unquote, urlencode

import pytest

from pipeline.desk.jobs import WorkerPool
from pipeline.desk.last_report import stat_sources
from pipeline.desk.page_request import Desk
from pipeline.desk.student import files as uploads
from pipeline.desk.student.files import take_uploads
from pipeline.desk.tasks import TASKS, make_report
from pipeline.errors import PipelineError
from pipeline.grading.intake.find import find_hand_ins
from pipeline.ingest.files import parse_table
from pipeline.lock import lock_when_free
from pipeline.processes import Failed
from pipeline.submission import load_submission
from pipeline.submission.edit import edit_submission
from pipeline.submission.load import NAME
from pipeline.words.progress import silent
from tests.helpers.desks import Answer, Visitor, a_submission, at_desk, some_files, wrongs
from tests.helpers.recordings import xlsx
from tests.helpers.waiting import until

HERE = "/student/0/"
pytestmark = pytest.mark.usefixtures("work_here")


@pytest.fixture
def room(tmp_path) -> Iterator[tuple[Visitor, Path]]:
    """Return a visitor who opened the desk on an empty folder, and the folder."""
    folder = tmp_path / "team"
    folder.mkdir()
    with at_desk(folder) as visitor:
        yield visitor, folder


@pytest.fixture
def filled(tmp_path) -> Iterator[tuple[Visitor, Path]]:
    """Return a visitor who opened the desk on a submission, and the folder."""
    folder = a_submission(tmp_path / "Gruppe ж 7")
    with at_desk(folder) as visitor:
        yield visitor, folder


def save(visitor: Visitor, where: str = "save", *, seen: str = "", **fields: str) -> Answer:
    """Send a form of the page as it is now."""
    shown = HERE + ("questions" if where in ("answer", "discussion") else "")
    return visitor.post(HERE + where, seen=seen or visitor.get(shown).value("seen"), **fields)


def table(*rows: str, head: str = "time,input,x1,x2") -> bytes:
    """Return a table of recorded values."""
    return "\n".join([head, *rows]).encode()


def hardly_moving(n: int = 400) -> bytes:
    """Return a recording of two carts, of which the second may have been held."""
    return table(*(f"{i / 100},0,{i % 200},{i % 6}" for i in range(n)))


@pytest.fixture(scope="module")
def workers():
    """Return the worker processes for short tasks, without a desk."""
    workers = WorkerPool()
    yield workers
    workers.close()


@pytest.fixture
def worker_here():
    """Return a worker in this process, in which a test can change limits."""

    class Here:
        def do(self, task: str, **arguments):
            return TASKS[task](**arguments, progress=silent)

    return Here()


def take_upload(name: str, content: io.BytesIO, folder: Path, *, workers: WorkerPool) -> list[str]:
    """Upload one file; return the message."""
    said = take_uploads([(name, content)], folder, workers=workers)
    assert all(("not uploaded" in line.text) == (line.tone == "refused") for line in said)
    return [line.text for line in said]


def ask_for(folder: Path, *ids: str) -> tuple[str, ...]:
    """Put a report that asks questions into the folder of the submission."""
    (folder / "report").mkdir(exist_ok=True)
    (folder / "report" / "report.html").write_text("<p>the report</p>", encoding="utf-8")
    (folder / "report" / "report.pdf").write_bytes(b"%PDF")
    asked = [{"id": id_, "text": "Why?"} for id_ in ids]
    told = {"questions": asked, "failed": [], "changes": "", "made_of": stat_sources(folder)}
    (folder / "report" / "questions.json").write_text(json.dumps(told), encoding="utf-8")
    return ids


def handed_in(visitor: Visitor) -> Answer:
    """Press "Hand in", wait for the report; return the page that lists the zip's content."""
    answer = visitor.post(HERE + "hand-in")
    assert (answer.status, answer.headers["location"]) == (303, HERE + "hand-in")
    until(lambda: "data-events" not in visitor.get(HERE + "hand-in").text)
    return visitor.get(HERE + "hand-in")


def zipped(visitor: Visitor) -> zipfile.ZipFile:
    """Return the zip file's content."""
    return zipfile.ZipFile(io.BytesIO(visitor.get(HERE + "hand-in.zip").body))


def test_an_error_is_shown_beside_its_field(filled):
    """An error in the form appears beside its field; the form keeps what was typed.

    The file is unchanged.
    """
    visitor, folder = filled
    before = (folder / NAME).read_bytes()
    typed = {"design.cart": "7", "reported.initial.K": "25,6", "system.input.per_count": "-1"}
    page = save(visitor, **typed)
    assert page.status == 422
    assert page.wrong_fields == {"reported-initial-K", "system-input-per_count"}
    assert page.value("reported.initial.K") == "25,6"
    assert save(visitor, **{"design.cart": "7"}).wrong_fields == {"design-cart"}
    assert (folder / NAME).read_bytes() == before


def test_a_row_is_corrected_in_place(filled):
    """Kind, carts and window of a recording can be corrected in its row.

    The recording's table in the file can be removed while the recording stays.
    """
    visitor, folder = filled
    index = next(i for i, e in enumerate(load_submission(folder).experiments) if e.kind == "step")
    path, where = f"experiments.{index}", f"experiments/{index}"
    row = {f"{path}.kind": "sweep", f"{path}.window": "0.5; 2", f"{path}.note": "bumped"}
    assert save(visitor, where, **row).status == 303
    experiment = load_submission(folder).experiments[index]
    assert (experiment.kind, experiment.window, experiment.note) == ("sweep", (0.5, 2.0), "bumped")
    assert save(visitor, where, remove="1").status == 303
    assert experiment.id not in [e.id for e in load_submission(folder).experiments]
    assert (folder / experiment.file).is_file()
    assert f'name="file" value="{experiment.file}"' in visitor.get(HERE).text


def test_a_recording_is_moved_aside_and_comes_back(filled):
    """A recording that no table names can be moved aside and back, never over another file.

    A file that is not a recording cannot be moved.
    """
    visitor, folder = filled
    (folder / "data" / "bad.csv").write_bytes(b"nothing in it")
    for round_ in ("bad.csv", "bad-2.csv"):
        assert "data/bad.csv" in visitor.get(HERE).text
        assert visitor.post(HERE + "aside", file="data/bad.csv").status == 303
        assert (folder / "set-aside" / round_).read_bytes() == b"nothing in it"
        assert round_ in visitor.get(HERE).text
        assert "data/bad.csv" not in visitor.get(HERE).text
        visitor.upload(HERE + "files", [("bad.csv", b"nothing in it")])
    named = load_submission(folder).experiments[0].file
    assert visitor.post(HERE + "aside", file=named).status == 422
    for other in (NAME, "notes.md", "../x.csv", "data/../submission.toml", ""):
        assert visitor.post(HERE + "aside", file=other).status == 404
    assert load_submission(folder).experiments[0].file == named
    assert (folder / named).is_file()


@pytest.mark.parametrize("packed", [True, False])
def test_invisible_characters_in_a_file_name_are_replaced(room, packed):
    """Special spaces and invisible characters in a file's name are replaced, with a message."""
    visitor, folder = room
    raw, marks = some_files()[0][1], "\u00a0\u200b\u202f\ufeff"
    sent = [(f"a{mark}b.csv", raw + b"\n" * i) for i, mark in enumerate(marks)]
    if packed:
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as file:
            for name, content in sent:
                file.writestr(name, content)
        sent = [("all.zip", archive.getvalue())]
    assert visitor.upload(HERE + "files", sent).status == 303
    page = unescape(visitor.get(HERE).text)
    names = ["a-b.csv", "a-b-2.csv", "a-b-3.csv", "a-b-4.csv"]
    assert sorted(path.name for path in (folder / "data").iterdir()) == sorted(names)
    assert r"'a\xa0b.csv': saved" in page
    assert {e.file for e in load_submission(folder).experiments} <= {f"data/{n}" for n in names}
    assert all(f"{name} <small>" in page for name in names)


@pytest.mark.parametrize("named", [True, False])
def test_moving_aside_waits_for_other_changes(filled, named):
    """A recording is moved aside only after other changes of the folder have ended.

    If a table then names the file, or the file is gone, nothing moves.
    """
    visitor, folder = filled
    recording = folder / "data" / "late.csv"
    recording.write_bytes(b"nothing in it")
    assert "data/late.csv" in visitor.get(HERE).text
    with ThreadPoolExecutor(1) as pool:
        with lock_when_free(folder):
            moved = pool.submit(visitor.post, HERE + "aside", file="data/late.csv")
            time.sleep(1.0)
            assert not moved.done()
            if named:
                text = (folder / NAME).read_text(encoding="utf-8")
                table = '\n[[experiments]]\nid = "late"\nkind = "decay"\nfile = "data/late.csv"\n'
                (folder / NAME).write_text(text + table, encoding="utf-8")
            else:
                recording.unlink()
        page = moved.result()
    assert (page.status, "late.csv" in page.text) == (422, True)
    assert recording.exists() == named


def test_handing_in_warns_of_open_questions(filled):
    """Before handing in, the page counts the open questions, but still offers the zip."""
    visitor, folder = filled
    ask_for(folder, "zeta", "level")
    for answered, open_ in (("", "2"), ("zeta", "1"), ("level", "0")):
        if answered:
            save(visitor, "answer", id=answered, answer="So.")
        page = visitor.get(HERE)
        assert page.state["unanswered"] == open_
        assert (f'<a href="{HERE}questions">answer first' in page.text) == (open_ != "0")
        assert f'action="{HERE}hand-in"' in page.text


@pytest.mark.parametrize(
    "change", ["number", "answer", "discussion", "older", "gone", "gap", "nothing"]
)
def test_handing_in_says_when_the_report_is_out_of_date(change, filled):
    """If anything has changed since the report, the page says so and the zip lacks the report."""
    visitor, folder = filled
    ask_for(folder, "zeta")
    file = folder / load_submission(folder).experiments[0].file
    if change == "number":
        save(visitor, **{"reported.final.K": "1.25"})
    elif change == "answer":
        save(visitor, "answer", id="zeta", answer="So.")
    elif change == "discussion":
        save(visitor, "discussion", discussion="So.")
    elif change == "older":
        file.write_bytes(file.read_bytes() + b"\n")
        os.utime(file, (1e9, 1e9))
    elif change == "gone":
        (file.parent / "unlisted.csv").write_bytes(b"")
        ask_for(folder, "zeta")
        (file.parent / "unlisted.csv").unlink()
    elif change == "gap":
        (folder / "gap").mkdir()
        (folder / "gap" / "gap.json").write_text("{}", encoding="utf-8")
    written = {"nothing": "current", "answer": "answered", "discussion": "answered"}
    expected = written.get(change, "older")
    for page in (visitor.get(HERE), visitor.get(HERE + "hand-in")):
        assert page.state["report"] == expected
        assert ("report is out" in page.text) == (expected == "older")
    top = visitor.get(HERE).text.partition('class="now')[2].partition('class="next')[0]
    said = {"older": "out of date", "current": "up to date", "answered": "are newer than"}
    assert [state for state, words in said.items() if words in top] == [expected]
    assert ("report/report.pdf" in zipped(visitor).namelist()) == (change == "nothing")


@pytest.mark.slow
@pytest.mark.sample
def test_the_content_of_the_zip_is_shown_before_handing_in(filled):
    """Before handing in, the page shows the zip's content, open questions and assumptions."""
    visitor, folder = filled
    text = (folder / NAME).read_text(encoding="utf-8")
    bare = re.sub(r"(?m)^(springs|input|position) = .*\n", "", text)
    (folder / NAME).write_text(bare, encoding="utf-8")
    (folder / "notes.md").unlink(missing_ok=True)
    page = unescape(handed_in(visitor).text)
    names = re.findall(r"<li>(\S+) <small>([\d,]+) bytes</small></li>", page.replace("<wbr>", ""))
    with zipped(visitor) as archive:
        held = {info.filename: f"{info.file_size:,}" for info in archive.infolist()}
    assert dict(names) == held
    assert "report/report.pdf" in held
    taken = re.findall(r"<li><code>(.*?)</code>(.*?)</li>", page)
    assert {key for key, _ in taken} >= {"system.springs", "system.position.unit",
                                         "system.input.unit", "system.input.sign"}  # fmt: skip
    assert dict(taken)["system.position.unit"].startswith(": count")
    archive = folder.parent / "one.zip"
    archive.write_bytes(visitor.get(HERE + "hand-in.zip").body)
    (found,) = find_hand_ins([archive], scratch=folder.parent / "scratch")
    assert found.problem == ""
    policy = visitor.get(HERE + "report/report.html").headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;")
    asked = json.loads((folder / "report" / "questions.json").read_bytes())["questions"]
    assert page.count(f'href="{HERE}questions#question-') == len(asked)


def test_only_an_up_to_date_report_lists_assumptions(filled):
    """The page lists a report's assumptions with reasons only if the report is up to date."""
    visitor, folder = filled
    ask_for(folder)
    asked = folder / "report" / "questions.json"
    assumed = [
        {"key": "system.springs", "about": "wall-1", "taken": "there", "why": "no step tells"},
        {"key": "system.input.sign", "about": "", "taken": "-1", "why": "all go down"},
    ]
    told = json.loads(asked.read_bytes()) | {"assumed": assumed}
    asked.write_text(json.dumps(told), encoding="utf-8")

    def shown() -> tuple[list[tuple[str, str]], int]:
        page = visitor.get(HERE + "hand-in").text
        return re.findall(r"<li><code>(.*?)</code>(.*?)</li>", page), page.count('"later"')

    assert shown() == (
        [("system.springs", ", wall-1: there (no step tells)"),
         ("system.input.sign", ": -1 (all go down)")], 0,
    )  # fmt: skip
    (folder / "notes.md").write_text("# Discussion\n", encoding="utf-8")  # notes change no number
    assert len(shown()[0]) == 2
    os.utime(folder / load_submission(folder).experiments[0].file, (1e9, 1e9))
    assert shown() == ([], 2)
    question = {"id": "zeta_1", "section": "parameters", "text": "Why?"}
    asked.write_text(json.dumps(told | {"questions": [question]}), encoding="utf-8")
    assert shown() == ([], 1)
    state = visitor.get(HERE + "hand-in").state
    assert (state["questions"], state["unanswered"]) == ("1", "1")


def test_a_failed_report_does_not_prevent_handing_in(filled):
    """If the report cannot be made, the error is named, and the zip is offered without a report."""
    visitor, folder = filled
    (folder / "report").symlink_to(folder.parent)
    page = handed_in(visitor)
    assert any("a link" in wrong for wrong in wrongs(page.text))
    assert (page.state["report"], page.state["known"]) == ("none", "no")
    assert page.text.count('"later"') == 2  # the page does not say that no questions are open
    assert "report/report.pdf" not in zipped(visitor).namelist()


def test_a_recording_uploaded_under_two_names_is_called_a_copy(room):
    """If a file is uploaded under two names, the message names the original.

    Only the first file gets a table.
    """
    visitor, folder = room
    (name, raw), *_ = some_files(most=1)
    visitor.upload(HERE + "files", [(name, raw), ("theirs.csv", raw)])
    (said,) = re.findall(r'class="said \w+">(data/theirs.csv: .*?)<', visitor.get(HERE).text)
    assert said.endswith(f"data/{name}") or f"data/{name}" in said
    assert [e.file for e in load_submission(folder).experiments] == [f"data/{name}"]
    assert f"{said}<" not in visitor.get(HERE).text  # said once


def test_a_file_in_doubt_needs_the_student(filled):
    """An essay, an empty file and one with unclear columns are counted apart from recordings.

    Columns are asked for only if a file can be read. If the report is up to date, the next step
    is still to hand in.
    """
    visitor, folder = filled
    before, data = visitor.get(HERE).state, folder / "data"
    assert before["look-at"] == "0"
    (data / "essay.txt").write_text("We measured much.\n" * 20, encoding="utf-8")
    (data / "empty.csv").write_bytes(b"")
    page = visitor.get(HERE)
    assert page.state == before | {"look-at": "2", "next": "files"}
    assert "its columns" not in page.text
    (data / "essay.txt").unlink()
    (data / "empty.csv").write_text("a,b\n1,2\n3,4\n5,6\n", encoding="utf-8")
    page = visitor.get(HERE)
    assert "its columns" in page.text
    assert 'id="kind-unknown" open><summary>' in page.text
    ask_for(folder)
    page = visitor.get(HERE)
    assert (page.state["next"], page.state["look-at"]) == ("hand-in", "1")
    now = page.text.partition('class="now')[2].partition("</section>")[0]
    assert '<button class="main" data-of-saved>' in now
    assert f'href="{HERE}#look-at"' in now


def spoil(file: Path) -> None:
    """Break every fifth row of a table, so that it cannot be used."""
    lines = file.read_bytes().splitlines(keepends=True)
    lines[5::5] = [b"broken\n" for _ in lines[5::5]]
    file.write_bytes(b"".join(lines))


def test_a_page_can_be_saved_a_hundred_changes_later():
    """The desk remembers the state that a page showed, even after a hundred further changes.

    If the states need too much memory, the oldest are forgotten.
    """
    desk, seen = Desk(), "seen"
    desk.keep_shown("title = ''", digest=seen, to="")
    for i in range(100):
        desk.keep_shown(f"title = '{i}'", digest=str(i), to="")
    assert desk.shown(seen, to="") == "title = ''"
    for i in range(40):
        desk.keep_shown(str(i % 10) * 1_000_000, digest=str(1000 + i), to="")
    assert desk.shown(seen, to="") is None
    assert desk.shown("1039", to="") is not None


def test_simultaneous_saves_and_answers_conflict(filled):
    """If several windows save or answer the same state at once, only one succeeds."""
    visitor, folder = filled
    seen = visitor.get(HERE).value("seen")
    titles = [f"window {i}" for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda title: save(visitor, seen=seen, title=title), titles))
    status = [answer.status for answer in answers]
    assert sorted(status) == [303] + 7 * [409]
    assert load_submission(folder).title == titles[status.index(303)]

    visitor, folder = filled
    asked = ask_for(folder, *(f"zeta_{i}" for i in range(6)))
    seen = visitor.get(HERE + "questions").value("seen")
    with ThreadPoolExecutor(6) as pool:
        sent = {
            id_: pool.submit(visitor.post, HERE + "answer", id=id_, answer=f"of {id_}", seen=seen)
            for id_ in asked
        }
    notes = (folder / "notes.md").read_text(encoding="utf-8")
    confirmed = {id_ for id_ in asked if sent[id_].result().status == 303}
    assert confirmed == {id_ for id_ in asked if f"of {id_}" in notes}
    assert len(confirmed) == 1


def test_an_answer_that_is_refused_stays_on_the_page(filled):
    """A refused answer stays on the page with the reason, and the notes do not change."""
    visitor, folder = filled
    ask_for(folder, "zeta")
    (folder / "notes.md").write_text("## level\n\nMine.\n", encoding="utf-8")
    seen = visitor.get(HERE + "questions").value("seen")
    for words in ("Because.\n```", "# Aha", "x" * 1_000_001):
        page = save(visitor, "answer", seen=seen, id="zeta", answer=words)
        assert page.status == 422
        assert len(wrongs(page.text)) == 2  # at the top and at the answer
        assert f"{words}</textarea>" in page.text
    assert words[:99] in save(visitor, "answer", seen=seen, id="gone", answer=words).text
    assert (folder / "notes.md").read_text(encoding="utf-8") == "## level\n\nMine.\n"
    (folder / "notes.md").write_bytes(b"\xff")
    page = save(visitor, "answer", seen=seen, id="zeta", answer="So.")
    assert (page.status, "So.</textarea>" in page.text) == (422, True)


def test_the_discussion_is_written_beside_the_answers(filled):
    """The form writes the discussion into `notes.md`; answers, comments and formulas stay."""
    visitor, folder = filled
    notes = folder / "notes.md"
    ask_for(folder, "zeta")
    notes.write_text("<!-- mine -->\n## zeta\n\nDry.\n\n## Outlook\n\nMore.\n", encoding="utf-8")
    page = visitor.get(HERE + "questions")
    assert "&lt;!-- mine --&gt;\n## Outlook\n\nMore.</textarea>" in page.text
    assert save(visitor, "discussion", discussion="As $\\zeta_b$ & <b>.").status == 303
    assert notes.read_text(encoding="utf-8") == "As $\\zeta_b$ & <b>.\n\n## zeta\n\nDry.\n"
    page = visitor.get(HERE + "questions")
    assert 'class="said refused"' not in page.text
    assert "As $\\zeta_b$ &amp; &lt;b&gt;.</textarea>" in page.text

    save(visitor, "discussion", discussion="As $\\foo$ and $\\bar x$.")
    said = re.findall('class="said refused">(.*?)</p>', visitor.get(HERE + "questions").text)
    assert [line.partition(" is ")[0] for line in said] == [r"$\foo$"]
    assert save(visitor, "discussion", discussion="").status == 303
    assert notes.read_text(encoding="utf-8") == "## zeta\n\nDry.\n"


def test_a_discussion_that_is_refused_stays_on_the_page(filled):
    """A discussion that would change an answer, or is outdated, is refused and shown again."""
    visitor, folder = filled
    ask_for(folder, "zeta")
    notes = folder / "notes.md"
    notes.write_text("## zeta\n\nMine.\n", encoding="utf-8")
    seen = visitor.get(HERE + "questions").value("seen")
    for words in ("So.\n```", "So <!-- why", "## Zeta\n\nHers.", "x" * 1_000_001):
        page = save(visitor, "discussion", seen=seen, discussion=words)
        assert page.status == 422
        assert len(wrongs(page.text)) == 2  # at the top and at the discussion
        assert f"{escape(words)}</textarea>" in page.text
    assert notes.read_text(encoding="utf-8") == "## zeta\n\nMine.\n"
    save(visitor, "answer", id="zeta", answer="Hers.")
    page = save(visitor, "discussion", seen=seen, discussion="Too late.")
    assert (page.status, "Too late." in page.text) == (409, True)
    assert notes.read_text(encoding="utf-8") == "## zeta\n\nHers.\n"


TYPO = "\n[reported.final]\nK_1 {}\n"


@pytest.mark.parametrize(
    ("text", "zipped_as"),
    [
        ("version = \n", 422), ("\xff", 422), ("version = 1\n[system]\ncarts = 9\n", 422),
        *((TYPO.format(typo), 200) for typo in ("= 24,3", "24.3", "=")),
        *((f"\n[reported.final]\nK = {number}\n", 200)
          for number in ("1e1000000", "1e-99999999999999999999", "0x" + "f" * 5000)),
    ],
)  # fmt: skip
def test_a_broken_submission_file_is_shown_with_its_error(filled, text, zipped_as):
    """If the file is broken, the page opens, says what is wrong, and offers no report.

    A mistyped number does not hide the recordings: none can be moved aside.
    """
    visitor, folder = filled
    before = visitor.get(HERE).text.count(f'action="{HERE}aside"')
    named = load_submission(folder).experiments[0].file
    old = (folder / NAME).read_text(encoding="utf-8").partition("[reported")[0]
    spoilt = old + text if text.startswith("\n") else text
    (folder / NAME).write_bytes(spoilt.encode("utf-8" if text.startswith("\n") else "latin-1"))
    page = visitor.get(HERE)
    assert page.status == 200
    assert wrongs(page.text) or page.wrong_fields
    if text.startswith("\n"):
        assert page.text.count(f'action="{HERE}aside"') == before
        assert visitor.post(HERE + "aside", file=named).status == 422
        assert visitor.upload(f"{HERE}files", [(NAME, spoilt.encode())]).status < 500
        assert visitor.get(HERE).status == 200
    else:
        assert f'action="{HERE}make-report"' not in page.text
    assert (folder / named).exists()
    assert visitor.get(HERE + "hand-in.zip").status == zipped_as


@pytest.mark.parametrize("broken", [b"version = \n", b"\xff", b"#" * 1_000_001])
def test_an_unreadable_submission_file_is_refused_and_can_be_replaced(broken, filled):
    """A `submission.toml` that cannot be read is not accepted as an upload.

    A valid one replaces an unreadable one on disk.
    """
    visitor, folder = filled
    sound = (folder / NAME).read_bytes()
    (folder / NAME).unlink()
    visitor.upload(HERE + "files", [(NAME, broken)])
    assert 'class="said refused"' in visitor.get(HERE).text
    (folder / NAME).write_bytes(broken)  # as an editor would
    visitor.upload(HERE + "files", [(NAME, sound)])
    assert load_submission(folder).experiments
    visitor.upload(HERE + "files", [(NAME, b"version = 1\n")])
    assert 'class="said refused"' in visitor.get(HERE).text
    assert (folder / NAME).read_bytes().startswith(sound[:200])


# ----------------------------------------------------------------------------- uploads

NAMES = {
    "../../escape.csv": "escape.csv", "..\\..\\escape.csv": "escape.csv", "C:\\a.csv": "a.csv",
    "/etc/a.csv": "a.csv", "con.csv": "data-con.csv", "a:b.csv": "a-b.csv", ".hidden.csv": None,
    "a\x00b.csv": "a-b.csv", "a\nb.csv": "a-b.csv", "x" * 300 + ".csv": "x" * 116 + ".csv",
    "<script>.csv": "-script-.csv", "'; --.csv": "'; --.csv",
    "学" * 116 + ".csv": "学" * 38 + ".csv", "x." * 60 + "csv": "-x." + "x." * 57 + "csv",
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_an_upload_is_always_stored_in_data(name, tmp_path, workers):
    """An uploaded recording is stored in `data`, whatever its name."""
    (tmp_path / "team").mkdir()
    take_upload(name, io.BytesIO(b"time,x1\n0,1\n"), tmp_path / "team", workers=workers)
    found = [path.relative_to(tmp_path / "team") for path in tmp_path.rglob("*.csv")]
    if NAMES[name]:
        assert found == [Path("data") / str(NAMES[name])]
    else:
        assert [path.parent for path in found] == [Path("data")]


def one_cart(folder: Path):
    """Return the unit of position of a submission."""
    return load_submission(folder).system.position.unit


CLICKS = {  # a button, the example whose files raise the doubt, and what is then stated
    "Use cm": ("one-cart", lambda s: s.system.position.unit, "cm"),
    "No spring here": ("two-cart", lambda s: s.system.springs[0], False),
    "Spring present": ("two-cart", lambda s: s.system.springs[0], True),
    "It was held": ("", lambda s: s.experiments[0].carts, (1,)),
}


@pytest.mark.parametrize("label", CLICKS)
def test_one_click_answers_a_doubt_and_saves_the_form(label, room):
    """One click states a unit, whether a spring exists or whether a cart was held.

    It also saves the whole form. The doubt is then gone, even if the answer confirms the file.
    """
    visitor, folder = room
    example, stated, expected = CLICKS[label]
    files = some_files(example) if example else [("a.csv", hardly_moving())]
    visitor.upload(HERE + "files", files)
    unsure = (folder / NAME).read_text(encoding="utf-8").count("# unsure")
    assert unsure
    typed = {"title": "Mine"} if example else {}
    answer(visitor, label, "save" if example else "experiments/0", **typed)
    submission = load_submission(folder)
    assert stated(submission) == expected
    assert submission.title == typed.get("title", submission.title)
    assert (folder / NAME).read_text(encoding="utf-8").count("# unsure") < unsure


def test_an_upload_never_replaces_a_file(tmp_path, workers):
    """An upload never replaces a file: an equal one is ignored, a different one gets a new name.

    Of several files of one name that are uploaded at once, each is kept. A linked file or folder
    is left alone. Notes are replaced only if they cannot be read.
    """
    for raw in (b"one", b"one", b"two", b"two"):
        take_upload("a.csv", io.BytesIO(raw), tmp_path, workers=workers)
    assert {p.name: p.read_bytes() for p in (tmp_path / "data").iterdir()} == {
        "a.csv": b"one", "a-2.csv": b"two",
    }  # fmt: skip
    secret = tmp_path / "secret"
    secret.write_bytes(b"secret")
    (tmp_path / "data" / "b.csv").symlink_to(secret)
    take_upload("b.csv", io.BytesIO(b"mine"), tmp_path, workers=workers)
    assert secret.read_bytes() == b"secret"
    assert (tmp_path / "data" / "b-2.csv").read_bytes() == b"mine"

    raws = [str(i).encode() * 200_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        for raw in raws:
            pool.submit(take_upload, "c.csv", io.BytesIO(raw), tmp_path, workers=workers)
    assert sorted(p.read_bytes() for p in (tmp_path / "data").glob("c*")) == raws

    for name in ("theirs", "mine"):
        (tmp_path / name).mkdir()
    (tmp_path / "mine" / "data").symlink_to(tmp_path / "theirs")
    with suppress(Failed, PipelineError):
        take_upload("a.csv", io.BytesIO(b"x"), tmp_path / "mine", workers=workers)
    assert list((tmp_path / "theirs").iterdir()) == []

    for broken in (b"\xff", b"x" * 1_000_001):
        (tmp_path / "notes.md").unlink(missing_ok=True)
        for name in ("notes.md", "there/notes.md"):
            assert take_upload(name, io.BytesIO(broken), tmp_path, workers=workers)
        (tmp_path / "notes.md").write_bytes(broken)
        assert take_upload("notes.md", io.BytesIO(b"So."), tmp_path, workers=workers) == []
        assert (tmp_path / "notes.md").read_bytes() == b"So."


def test_an_uploaded_archive_must_obey_the_limits(tmp_path, workers):
    """Recordings in a zip file are stored; zip bombs, links and paths outside are refused."""

    def packed(*members: tuple[str, bytes]) -> io.BytesIO:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, raw in members:
                archive.writestr(name, raw)
        return io.BytesIO(buffer.getvalue())

    good = packed(("team/data/a.csv", b"x"), ("team/plot.py", b"import os"), ("__MACOSX/a", b"y"))
    (said,) = take_upload("a.zip", good, tmp_path, workers=workers)
    assert "plot.py" in said
    for wrong in (packed(("big.csv", bytes(30_000_000))), packed(("../out.csv", b"x")),
                  io.BytesIO(b"PK")):  # fmt: skip
        (said,) = take_upload("b.zip", wrong, tmp_path, workers=workers)
        assert "not uploaded" in said
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.csv")] == [
        "data/a.csv"
    ]


def test_a_folder_accepts_files_up_to_the_limits(tmp_path, worker_here, monkeypatch):
    """A folder accepts files up to the limits on a submission's size and number of files.

    Files that will not be in the zip do not count.
    """
    monkeypatch.setattr(uploads, "MAX_DATA_BYTES", 10)
    (tmp_path / "whole").mkdir()
    (said,) = take_upload("a.csv", io.BytesIO(b"x" * 11), tmp_path, workers=worker_here)
    assert "10 bytes" in said
    monkeypatch.setattr(uploads, "HAND_IN", uploads.HAND_IN.__class__(members=2, total=15))
    for name in ("set-aside/old.csv", "report/report.html", "gap/gap.json", "raw/session-1/a.bin"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(bytes(100))
    assert take_upload("a.csv", io.BytesIO(b"x" * 10), tmp_path, workers=worker_here) == []
    (said,) = take_upload("b.csv", io.BytesIO(b"y" * 6), tmp_path, workers=worker_here)
    assert all(limit in said for limit in ("2 files", "15 bytes"))
    three = [(f"{n}.csv", io.BytesIO(b"123456"[:n])) for n in (4, 5, 6)]
    (said,) = take_uploads(three, tmp_path / "whole", workers=worker_here)
    assert said.text.startswith("'6.csv': ")
    assert "2 files" in said.text


def test_only_our_own_files_are_served_and_nothing_in_them_runs(filled):
    """The desk serves the report's files and the zip, but no other file of the folder.

    Scripts of a report that is not the program's own do not run. Names and headings of files are
    never markup.
    """
    visitor, folder = filled
    packed = visitor.get(HERE + "hand-in.zip").headers["content-disposition"]
    plain, _, whole = packed.partition("; filename*=UTF-8''")
    assert plain == 'attachment; filename="Gruppe---7.zip"'
    assert unquote(whole) == "Gruppe ж 7.zip"
    report, evil = folder / "report", "<img src=x onerror=alert(1)>"
    report.mkdir(exist_ok=True)
    (report / "x.json").write_text("{}", encoding="utf-8")
    (report / "y.json").symlink_to("/etc/hostname")
    (report / "report.html").write_text("<script>alert(1)</script>", encoding="utf-8")
    assert visitor.get(HERE + "report/x.json").body == b"{}"
    for name in ("y.json", "../submission.toml", "%2e%2e/submission.toml", "../notes.md", ".lock",
                 "..%2fsubmission.toml", "//etc/hostname", "nothing.html"):  # fmt: skip
        assert visitor.get(HERE + "report/" + name).status == 404, name
    policy = visitor.get(HERE + "report/report.html").headers["content-security-policy"]
    scripts = next(part for part in policy.split(";") if "script-src" in part)
    assert scripts.split()[1:] == re.findall(r"'sha256-[^']+'", scripts)
    (folder / "data" / f"{evil}.csv").write_text(f"{evil},x1\n" + "1,2\n" * 20, encoding="utf-8")
    visitor.post(HERE + "fill")
    page = visitor.get(HERE).text
    assert ("<img" in page, "&lt;img" in page) == (False, True)


# -------------------------------------------------------------------------------- jobs


@pytest.mark.slow
@pytest.mark.sample
def test_the_gap_is_found_as_a_job(filled):
    """The desk finds the gap as a job, keeps `gap.json`, and shows the page in a sandbox."""
    visitor, folder = filled
    assert visitor.get(HERE + "gap/gap.html").status == 404
    assert visitor.post(HERE + "make-gap").status == 303
    until(lambda: "gap/gap.html" in visitor.get(HERE).text)
    page = visitor.get(HERE + "gap/gap.html")
    assert page.headers["content-security-policy"].startswith("sandbox allow-scripts;")
    assert json.loads((folder / "gap" / "gap.json").read_bytes())["schema"] == "cartlab-gap/1"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names, and links need rights")
def test_unread_files_are_listed_with_advice(filled):
    """Files that are not read are listed with advice, for example a spreadsheet or a link."""
    visitor, folder = filled
    assert 'class="not-read"' not in visitor.get(HERE).text
    for name in ("book.ods", "<b>.docx"):
        (folder / "data" / name).write_bytes(b"PK")
    (folder / "data" / "away.csv").symlink_to(__file__)
    page = visitor.get(HERE).text
    listed = page.partition('class="not-read"')[2].partition("</ul>")[0]
    advised = re.findall(r"<li><b>(.*?)</b>: .*?; (.*?)</li>", listed)
    assert {"data/book.ods", "data/away.csv"} <= {name for name, _ in advised}
    assert ".xlsx" in dict(advised)["data/book.ods"]
    assert "&lt;b&gt;.docx" in listed


# ------------------------------------------------------------- doubts answered by one click


def answers(page: Answer) -> dict[str, str]:
    """Return the buttons that answer a doubt: their texts and what each one enters."""
    found = re.findall(r'<button name="answer" value="([^"]*)">([^<]*)</button>', page.text)
    return {unescape(label): unescape(value) for value, label in found}


def answer(visitor: Visitor, label: str, where: str = "save", **typed: str) -> None:
    """Press the button that answers a doubt, after which it is gone."""
    given = answers(visitor.get(HERE))[label]
    assert save(visitor, where, answer=given, **typed).status == 303
    assert label not in answers(visitor.get(HERE))


def test_one_click_reverses_a_contradicted_sign(filled):
    """If an up-to-date report contradicts the stated sign, one click reverses it."""
    visitor, folder = filled
    ask_for(folder)
    asked = folder / "report" / "questions.json"
    wrong = {"key": "system.input.sign", "about": "", "value": 1.0, "support": "contradicted",
             "taken": "+1", "why": "all-down"}  # fmt: skip
    told = json.loads(asked.read_bytes()) | {"contradicted": [wrong]}
    asked.write_text(json.dumps(told), encoding="utf-8")
    assert "all-down" in visitor.get(HERE).text
    answer(visitor, "Reverse the sign")  # afterwards the report is out of date
    assert load_submission(folder).system.input.sign == -1


@pytest.mark.slow
@pytest.mark.sample
def test_one_click_states_the_sign_of_turned_runs(tmp_path):
    """If some runs have the opposite sign, one click states the sign in these runs only."""
    folder = a_submission(tmp_path / "team")

    def bare(document):
        del document["system"]["input"]

    runs = edit_submission(folder, bare).experiments
    turned = next(run for run in runs if run.kind == "step")
    rows = (folder / turned.file).read_text(encoding="utf-8").splitlines()
    place = rows[0].split(",").index("input")
    logged = [row.split(",") for row in rows[1:]]
    for row in logged:
        row[place] = f"{-float(row[place])!r}"
    text = "\n".join([rows[0], *map(",".join, logged)])
    (folder / turned.file).write_text(text, encoding="utf-8")
    make_report(str(folder), progress=silent)
    with at_desk(folder) as visitor:
        save(visitor, "answer", id="sign", answer="The plug.")
        form = rf'name="seen" value="(\w+)"><p class="answers"><button>[^<]* in {turned.id}<'
        (seen,) = re.findall(form, visitor.get(HERE + "questions").text)
        assert save(visitor, "state-signs", seen="0" * 64).status == 409
        assert save(visitor, "state-signs", seen=seen).status == 303
        assert f"{HERE}state-signs" not in visitor.get(HERE + "questions").text
    signs = {run.id: run.input and run.input.sign for run in load_submission(folder).experiments}
    assert {id_: sign for id_, sign in signs.items() if sign} == {turned.id: -1}


def test_warnings_that_differ_in_a_number_appear_once(room):
    """Warnings that differ only in a number appear once, with the smallest and largest number."""
    visitor, _ = room
    for name, interval in (("a", 0.0103), ("b", 0.0104), ("c", 0.0105)):
        rows = [f"{round(i * interval, 3)},{i // 50},{i % 99 * 7}" for i in range(400)]
        visitor.upload(HERE + "files", [(f"{name}.csv", table(*rows, head="time,input,x1"))])
    page = visitor.get(HERE).text
    assert page.count("10.3 to 10.5") == 1
    assert "10.4 ms" not in page


def test_rows_show_what_their_kind_needs(filled):
    """A closed loop's row asks for its controller in one folded line until the line is filled in.

    Only the row of a dwell asks for a frequency. A note keeps its lines, blank ones included.
    """
    visitor, folder = filled
    kinds = [run.kind for run in load_submission(folder).experiments]
    place = kinds.index("step")
    row = f"experiments.{place}"
    assert f'id="loop-{place}"' not in visitor.get(HERE).text
    save(visitor, f"experiments/{place}", **{f"{row}.kind": "closed_loop"})
    page = visitor.get(HERE).text
    assert f'id="loop-{place}"><summary>' in page
    assert f"{row}.controller.kp" not in page
    assert f'id="more-{place}"><summary>' in page  # no other field of the loop is asked for
    save(visitor, f"experiments/{place}", **{f"{row}.controller.type": "pid"})
    page = visitor.get(HERE).text
    assert f'id="loop-{place}" open><summary>' in page
    assert f"{row}.controller.kp" in page
    assert f"{row}.controller.gains" not in page
    dwells = {str(i) for i, kind in enumerate(kinds) if kind == "sine"}
    assert set(re.findall(r'name="experiments\.(\d+)\.frequency"', page)) == dwells

    visitor, folder = filled
    note = "one\n\ntwo\n"
    edit_submission(folder, lambda d: d["experiments"][0].update(note=note))
    field = r'<textarea[^>]* name="experiments.0.note"[^>]*>([^<]*)</textarea>'
    (shown,) = re.findall(field, visitor.get(HERE).text)
    row = {"experiments.0.note": shown.replace("\n", "\r\n"), "experiments.0.window": "0.5; 2"}
    assert save(visitor, "experiments/0", **row).status == 303
    experiment = load_submission(folder).experiments[0]
    assert (experiment.note, experiment.window) == (note, (0.5, 2.0))


def test_one_click_answers_for_several_recordings(room):
    """If several recordings raise the same question, one click answers it for all of them.

    A click that names recordings which do not exist is refused.
    """
    visitor, folder = room
    for name, n in (("a", 400), ("b", 420), ("c", 440)):
        visitor.upload(HERE + "files", [(f"{name}.csv", hardly_moving(n))])
    page, held = visitor.get(HERE), 'name="carts" value="1"'
    assert held in page.text
    before, seen = (folder / NAME).read_text(encoding="utf-8"), page.value("seen")
    for wrong in ("3", "-1", "x", ""):
        sent = save(visitor, "answer-together", seen=seen, carts="1", recording=wrong)
        assert sent.status == 422
    assert (folder / NAME).read_text(encoding="utf-8") == before
    body = urlencode({"seen": seen, "carts": "1", "recording": [0, 1, 2]}, doseq=True).encode()
    kind = "application/x-www-form-urlencoded"
    assert visitor.send(HERE + "answer-together", body, kind=kind).status == 303
    assert [run.carts for run in load_submission(folder).experiments] == [(1,)] * 3
    assert "unsure: cart 2" not in (folder / NAME).read_text(encoding="utf-8")
    assert held not in visitor.get(HERE).text
    assert visitor.send(HERE + "answer-together", body, kind=kind).status == 409  # outdated


def test_recordings_that_need_the_student_come_first(filled):
    """Rows are grouped by kind and folded; those that need the student come first and are open.

    A recording whose last row was cut off is used, and its row says so.
    """
    visitor, folder = filled
    file = folder / "data" / "decay-1b.csv"
    file.write_bytes(file.read_bytes()[:-3].rpartition(b",")[0])
    page = visitor.get(HERE).text
    assert "cut off" in page
    kinds = {e.kind for e in load_submission(folder).experiments}
    assert {f'id="kind-{kind}"><summary>' in page for kind in kinds} == {True}
    assert "rest-decay" not in page
    spoil(file)
    group = visitor.get(HERE).text.partition('id="kind-decay" open')[2].partition("</section>")[0]
    first, _, rest = group.partition('<details class="kind" id="rest-decay"><summary>')
    assert ("decay-1b.csv" in first, "decay-1b.csv" in rest) == (True, False)
    assert "line 6" in first
    assert re.match(r"\d+ ", rest)


def test_edits_from_outside_or_in_another_tab_are_not_overwritten(filled):
    """If the file was changed after a page was shown, a form or answer of the page is refused.

    The refusal shows both versions of the fields that this tab changed.
    """
    visitor, folder = filled
    page = visitor.get(HERE)
    shown, seen = {name: page.value(name) for name in ("title", "section")}, page.value("seen")
    assert save(visitor, seen=seen, **shown | {"section": "07"}).status == 303
    answer = save(visitor, seen=seen, **shown | {"title": "Mine"})
    assert answer.status == 409
    rows = re.findall(r'<tr><th scope="row">.*?<pre>(.*?)</pre>.*?<pre>(.*?)</pre>', answer.text)
    assert rows == [("Mine", shown["title"])]

    text = (folder / NAME).read_text(encoding="utf-8")
    title = re.sub(r"(?m)^title = .*$", 'title = "Outside"  # ours', text)
    (folder / NAME).write_text(title, encoding="utf-8")
    assert visitor.get(HERE).value("title") == "Outside"
    for path, field in (("save", {"title": "Mine"}), ("experiments/0", {"remove": "1"})):
        page = save(visitor, path, seen=seen, **field)
        assert (page.status, "Outside" in page.text) == (409, True)
        assert (folder / NAME).read_text(encoding="utf-8") == title
    unknown = visitor.post(HERE + "save", title="Mine")  # seen nothing
    assert (unknown.status, "You typed" in unknown.text) == (409, False)
    (folder / "notes.md").write_text("Other words.\n", encoding="utf-8")
    page = save(visitor, "answer", seen=seen, id="zeta", answer="Mine")
    assert (page.status, "Other words." in page.text, "Mine" in page.text) == (409, True, True)
    assert (folder / "notes.md").read_text(encoding="utf-8") == "Other words.\n"


def test_uploads_are_told_apart(room):
    """Accepted, changed and refused files differ in look, and each message names its file.

    An Excel file is uploaded like any other; if it is broken, its row says so.
    """
    visitor, _ = room
    raw = some_files(most=1)[0][1]
    sent = [("a.csv", raw), ("a.csv", raw + b"\n"), ("plot.py", b"import os")]
    visitor.upload(HERE + "files", sent)
    files = unescape(visitor.get(HERE).text).partition('id="files"')[2]
    said = re.findall(r'<p class="said (\w+)">(.*?)</p>', files)
    assert {tone for tone, _ in said} == {"done", "changed", "refused"}
    for tone, name in (("changed", "a-2.csv"), ("refused", "plot.py")):
        assert any(one == tone and name in text for one, text in said)

    visitor, folder = room
    (name, raw), *_ = [one for one in some_files() if one[0].startswith("step")]
    recorded = parse_table(raw, source=name)
    sheet = xlsx(dict(zip(recorded.names, recorded.values, strict=True)))
    visitor.upload(HERE + "files", [("My run.xlsx", sheet), ("cut.xlsx", sheet[: len(sheet) // 2])])
    page = visitor.get(HERE)
    assert "workbook is broken" in page.text
    assert page.text.count("<polyline") >= 1
    kinds = {run.file: run.kind for run in load_submission(folder).experiments}
    assert kinds.pop("data/My run.xlsx") == "step"
    assert not [file for file in kinds if file.endswith("xlsx")]
