"""The desk in a real browser: from an empty folder to the zip, by day, by night, on a phone."""

import re
import signal
import subprocess
import sys
import urllib.request
import zipfile
from pathlib import Path
from urllib.error import HTTPError

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.identify.springs import fill_folder
from pipeline.submission import load_submission
from pipeline.submission.load import NAME
from tests.desk.test_student import ask_for
from tests.helpers.accessibility import violations
from tests.helpers.desks import a_submission
from tests.helpers.places import ROOT
from tests.helpers.waiting import PATIENCE, started, until
from tests.system.test_report_pages import PHONE, WIDE

FILES = sorted((ROOT / "submissions" / "one-cart" / "data").iterdir())


@pytest.fixture
def show(open_window):
    """Open a desk in a new window; the secret of its address is no longer shown then."""

    def opened(url: str, **options):
        window = open_window(url, **options)
        assert re.fullmatch(r"http://[^/]+/(\w+/0/)?", window.url)
        return window

    return opened


def fits(window) -> bool:
    """Return whether everything fits the screen, and axe finds no barrier by day or night.

    Axe checks the page at a phone's size, which needs the most scrolling and touching.
    """
    own = window.viewport_size
    for width, height in (WIDE, PHONE):
        window.set_viewport_size({"width": width, "height": height})
        # Plots are drawn again for the new size. If the page never fits, this raises an error.
        until(lambda most=width: window.evaluate("document.documentElement.scrollWidth") <= most)
    assert violations(window) == []
    window.set_viewport_size(own)
    return True


def walk_to(window, control) -> None:
    """Press Tab until the control has the focus."""
    for _ in range(200):
        if control.evaluate("one => one === document.activeElement"):
            return
        window.keyboard.press("Tab")
    raise AssertionError(f"no Tab leads to {control}")


def unfold(window) -> None:
    """Open all groups of files and of the set-up."""
    for summary in window.locator("details.kind:not([open]) > summary").all()[::-1]:
        summary.click()


@pytest.mark.slow
@pytest.mark.sample
def test_a_student_goes_from_an_empty_folder_to_the_zip(show, tmp_path):
    """A student drops files, answers, corrects a mistake, reads the report, downloads the zip."""
    folder = tmp_path / "team"
    with DeskServer() as server:
        window = show(server.url)
        window.get_by_text("Type a path").click()
        window.get_by_label("Folder on this computer").fill(str(folder))
        with window.expect_navigation():  # to a page whose scripts accept files
            window.get_by_role("button", name="Open").click()
        expect(window.get_by_role("heading", level=1)).to_have_text("team")
        stands = window.get_by_label("Current state")

        window.locator("#drop").set_input_files(FILES)
        expect(window.locator("table.files tbody tr")).to_have_count(len(FILES))
        assert len(load_submission(folder).experiments) == len(FILES)
        expect(window.locator("#files").get_by_text("written into")).to_be_visible()

        window.get_by_label("Title of the report").fill("One <b>cart</b>")
        window.get_by_label("You", exact=True).fill("s1")
        window.get_by_role("button", name="Use cm").click()  # also saves the typed text
        expect(window.locator("#details").get_by_text("Saved.")).to_be_visible()
        assert load_submission(folder).system.position.unit == "cm"
        expect(window.get_by_role("button", name="Use cm")).to_have_count(0)
        window.get_by_text("The controller to design").click()
        window.get_by_label("Cart whose position").fill("2")
        save = window.locator("#details").get_by_role("button", name="Save")
        save.click()
        expect(window.locator("#design-cart-wrong")).to_contain_text("there is no cart 2")
        window.get_by_label("Cart whose position").fill("1")
        window.get_by_label("K final").fill("28.9")
        save.click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        step = next(e for e in load_submission(folder).experiments if e.kind == "step")
        window.locator("#kind-step > summary").click()
        row = window.get_by_role("row").filter(has_text=Path(step.file).name)
        row.get_by_text(step.id, exact=True).click()
        row.get_by_label("Note").fill("the cart was bumped")
        row.get_by_role("button", name="Save").click()
        until(lambda: "bumped" in (folder / NAME).read_text(encoding="utf-8"))
        expect(row).to_be_visible()  # a row that was opened stays open
        expect(window.locator("#files").get_by_text("Saved.")).to_be_visible()
        window.get_by_text("Which controller ran?").click()
        window.get_by_label("Controller", exact=True).select_option("state_feedback")
        chip = window.locator("#kind-closed_loop .chip")
        expect(chip).to_have_text("1 to look at")  # the gains are not stated yet
        expect(window.get_by_label("Prefilter").first).to_be_visible()  # not folded away
        window.get_by_label("Gains").first.fill("0.002809, 0.003984")
        window.locator("#kind-closed_loop").get_by_role("button", name="Save").click()
        expect(chip).to_have_text("understood")
        assert fits(window)

        window.get_by_role("button", name="Make the report").click()
        expect(window.locator("[data-events]")).to_contain_text("The report")
        window.reload()
        window.get_by_role("link", name="Read the report").click()
        report = window.frame_locator("iframe")
        expect(report.get_by_role("heading", level=1)).to_have_text("One <b>cart</b>")
        expect(report.locator("button.copy").first).to_be_attached()  # the report's script works
        own = "document.documentElement.scrollHeight - innerHeight"
        assert window.evaluate(own) <= 0  # only the report scrolls, not the page around it
        assert fits(window)
        window.get_by_role("link", name="Back to the files").click()
        window.locator("#group-who > summary").click()
        window.get_by_label("Title of the report").fill("Two carts")
        window.locator("#details").get_by_role("button", name="Save").click()
        expect(stands).to_contain_text("The report is out of date")
        window.get_by_role("button", name="Hand in", exact=True).click()
        expect(
            window.get_by_text("The report in the zip matches your current files")
        ).to_be_visible()
        assert "Two carts" in (folder / "report" / "report.html").read_text(encoding="utf-8")
        assert fits(window)
        with window.expect_download() as download:
            window.get_by_role("link", name="Download the zip").click()
        with zipfile.ZipFile(download.value.path()) as archive:
            assert {NAME, "notes.md", "report/report.pdf"} <= set(archive.namelist())
        window.reload()
        way = window.get_by_label("Steps").get_by_role("listitem")
        # A check fails, so the report is made, but its step is not green.
        expect(way.filter(has_text="Report").locator(".chip")).to_have_class("chip doubt")
    submission = load_submission(folder)
    assert submission.title == "Two carts"
    assert "bumped" in next(e for e in submission.experiments if e.id == step.id).note


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("work_here")
def test_the_keyboard_alone_suffices_on_a_phone(show, tmp_path):
    """With keys alone, on a phone, a student answers a question about units and gets the zip."""
    folder = tmp_path / "team"
    (folder / "data").mkdir(parents=True)
    for file in FILES:
        if "control" not in file.name:  # for that recording the page asks which controller ran
            (folder / "data" / file.name).write_bytes(file.read_bytes())
    fill_folder(folder)
    with DeskServer(folder=folder) as server:
        window = show(server.url, size=PHONE)
        walk_to(window, window.get_by_role("link", name="Complete the set-up"))
        window.keyboard.press("Enter")
        walk_to(window, window.get_by_label("Title of the report"))
        window.keyboard.type("Typed")
        walk_to(window, window.get_by_label("You", exact=True))
        window.keyboard.type("s1")
        walk_to(window, window.get_by_role("button", name="Use cm"))
        window.keyboard.press("Enter")
        expect(window.locator("#details").get_by_text("Saved.")).to_be_visible()
        walk_to(window, window.get_by_label("K final"))
        window.keyboard.type("28.9")
        window.keyboard.press("Enter")
        until(lambda: load_submission(folder).reported is not None)
        button = window.get_by_role("button", name="Make the report")
        expect(button).to_have_class("main")  # the page suggests this step next
        walk_to(window, button)
        window.keyboard.press("Space")
        stands = window.get_by_label("Current state")
        answer = stands.get_by_role("link", name=re.compile("Answer . question"))
        expect(answer.or_(stands.get_by_role("button", name="Hand in"))).to_be_visible()
        if answer.count():
            walk_to(window, answer)
            with window.expect_navigation():
                window.keyboard.press("Enter")
            assert fits(window)
            for box in window.locator("textarea").all():
                walk_to(window, box)
                window.keyboard.type("Because of friction.")
                window.keyboard.press("Tab")
                window.keyboard.press("Enter")
                expect(window.get_by_text("Written into notes.md.")).to_be_visible()
        walk_to(window, stands.get_by_role("button", name="Hand in"))
        with window.expect_navigation():
            window.keyboard.press("Enter")
        download = window.get_by_role("link", name="Download the zip")
        expect(download).to_be_visible()
        walk_to(window, download)
        with window.expect_download() as got:
            window.keyboard.press("Enter")
        with zipfile.ZipFile(got.value.path()) as archive:
            assert "report/report.pdf" in archive.namelist()


@pytest.mark.usefixtures("work_here")
def test_typed_text_stays_until_it_is_saved(show, tmp_path):
    """Typed text stays if another form is saved, a row is removed or a save is refused."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        title, details = window.get_by_label("Title of the report"), window.locator("#details")
        unfold(window)
        title.fill("typed")
        details.get_by_role("checkbox").first.uncheck()
        window.locator("#row-1 summary").click()
        note = window.locator("#experiments-1-note")
        note.evaluate("note => { note.value = 'bumped' }")  # typed, but without leaving the row
        window.locator("#row-0 summary").click()
        window.locator("#row-0").get_by_role("button", name="Remove").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        expect(window.locator("#experiments-0-note")).to_have_value("bumped")
        expect(window.locator("#experiments-0-note")).to_be_visible()
        expect(title).to_have_value("typed")
        expect(details.get_by_role("checkbox").first).not_to_be_checked()

        text = (folder / NAME).read_text(encoding="utf-8")
        (folder / NAME).write_text(f"{text}# from outside\n", encoding="utf-8")
        window.locator("#row-0").get_by_role("button", name="Save").click()
        heading = window.get_by_role("heading", level=1)
        expect(heading).to_have_text(f"{NAME} was changed meanwhile")
        expect(window.get_by_text("Nothing was written")).to_be_visible()
        window.get_by_role("link", name="Continue with the current file").click()
        expect(heading).to_have_text("team")
        expect(title).to_have_value("typed")
        details.get_by_role("button", name="Save").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
    submission = load_submission(folder)
    assert (submission.title, submission.system.springs[0]) == ("typed", False)


@pytest.mark.usefixtures("work_here")
def test_one_key_answers_for_several_recordings(show, tmp_path):
    """If several recordings ask the same question, one key answers it for all of them."""
    folder = tmp_path / "team"
    (folder / "data").mkdir(parents=True)
    for name, n in (("a", 400), ("b", 420), ("c", 440)):
        rows = [f"{i / 100},0,{i % 200},{i % 6}" for i in range(n)]
        text = "\n".join(["time,input,x1,x2", *rows])
        (folder / "data" / f"{name}.csv").write_text(text, encoding="utf-8")
    fill_folder(folder)
    with DeskServer(folder=folder) as server:
        window = show(server.url, size=PHONE)
        assert fits(window)
        row = window.locator("#row-0")
        row.get_by_role("button", name="It was free").press("Enter")
        for name in ("a.csv", "b.csv", "c.csv"):
            shown = window.locator("tr").filter(has_text=name)
            expect(shown).to_be_visible(visible=name != "a.csv")  # one answer is enough for a.csv
        window.get_by_role("button", name="It was held in all 2").press("Enter")
        expect(window.locator("#files details.kind[open]")).to_have_count(0)
        assert fits(window)
    runs = load_submission(folder).experiments
    assert [run.carts for run in runs] == [(1, 2), (1,), (1,)]


@pytest.mark.slow
@pytest.mark.sample
def test_zip_and_report_wait_for_unsaved_text(show, tmp_path):
    """While typed text is not saved, no zip or report is made, and a message says why."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        asked = []
        window.on("request", lambda request: asked.append(request.url.rsplit("/", 1)[1]))
        title, held = window.get_by_label("Title of the report"), window.get_by_role("alert")
        unfold(window)
        title.fill("typed")
        for section, name, role in (
            ("#hand-in", "Hand in", "button"),
            (".now", "Make the report", "button"),
            ("#report", "Look for what", "button"),
        ):
            within = window.locator(section)
            shown = within.get_by_role("alert").count()
            within.get_by_role(role, name=name).first.click()
            expect(within.get_by_role("alert")).to_have_count(shown + 1)
        assert not {"hand-in", "make-report", "make-gap"}.intersection(asked)
        assert violations(window) == []
        window.get_by_role("button", name="hand in without them").click()  # despite the warning
        with window.expect_download() as download:
            window.get_by_role("link", name="Download the zip").click()
        with zipfile.ZipFile(download.value.path()) as archive:
            assert "typed" not in archive.read(NAME).decode()

        window.get_by_role("link", name="Back to the files").click()
        expect(title).to_be_attached()
        unfold(window)
        title.fill("typed")
        window.locator("#details").get_by_role("button", name="Save").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        expect(held).to_have_count(0)
        window.get_by_role("button", name="Hand in", exact=True).click()
        with window.expect_download() as download:
            window.get_by_role("link", name="Download the zip").click()
        with zipfile.ZipFile(download.value.path()) as archive:
            assert 'title = "typed"' in archive.read(NAME).decode()

        window.get_by_role("link", name="Back to the files").click()
        expect(title).to_be_attached()
        unfold(window)
        title.fill("typed again")
        window.get_by_role("button", name="Make the report again").click()
        window.get_by_role("button", name="continue without them").click()
        expect(window.locator("[data-events]")).to_contain_text("The report")
        expect(title).to_have_value("typed again")


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("work_here")
def test_the_desk_is_accessible(show, tmp_path):
    """The desk is accessible (axe) by day and night, fits every screen and works by keyboard."""
    folder = a_submission(tmp_path / "team", "two-cart")
    with DeskServer(folder=folder) as server:
        window = show(server.url, size=PHONE)
        unfold(window)
        table = window.locator(".wide").filter(has=window.locator("table.files")).first
        assert table.evaluate("it => it.scrollWidth <= it.clientWidth")  # the table fits its frame
        window.get_by_label("Size of one encoder count").fill("0")
        window.get_by_label("Size of one encoder count").press("Enter")
        expect(window.locator("#system-position-per_count-wrong")).to_be_visible()
        for summary in window.locator("details.kind:not([open]) > summary").all()[::-1]:
            summary.press("Enter")
        assert fits(window)
        for page in ("student/0/report", "student/0/questions", "student/0/hand-in", ""):
            window.goto(f"{window.url.split('student')[0]}{page}")
            assert fits(window)
        window.keyboard.press("Tab")
        expect(window.get_by_role("link", name="Skip to the content")).to_be_focused()


@pytest.mark.usefixtures("work_here")
def test_the_desk_works_without_scripts(show, tmp_path):
    """Without scripts every change can be made with a plain form."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url, java_script_enabled=False)
        unfold(window)
        window.get_by_label("Title of the report").fill("Plain")
        window.locator("#details").get_by_role("button", name="Save").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        window.locator("#drop").set_input_files([FILES[0]])
        window.get_by_role("button", name="Upload", exact=True).click()
        expect(window.get_by_text("already exists")).to_be_visible()
    assert load_submission(folder).title == "Plain"


# The texts and the fields of a page, also those that are folded.
SHOWN = """() => {
  const main = document.querySelector("#main").cloneNode(true);
  for (const one of main.querySelectorAll("noscript, div[role=status]")) one.remove();
  const fields = document.querySelectorAll("input:not([type=hidden]), select, textarea");
  return [...main.textContent.split(/\\s+/), ...[...fields].map(
    one => `${one.name}=${one.type == "checkbox" ? one.checked : one.value}`)];
}"""


@pytest.mark.usefixtures("work_here")
@pytest.mark.parametrize("scripts", [True, False])
def test_a_change_updates_the_page_wherever_it_matters(show, tmp_path, scripts):
    """After a changed note, a changed kind or a removed recording, a reload would change nothing.

    With scripts, only the changed rows are sent: 33 recordings and one note are at most 10 kB.
    """
    folder = a_submission(tmp_path / "team", "two-cart")
    ask_for(folder)
    index, run = next((i, e) for i, e in enumerate(load_submission(folder).experiments)
                      if e.kind == "step")  # fmt: skip
    with DeskServer(folder=folder) as server:
        window = show(server.url, java_script_enabled=scripts)
        stands = window.get_by_label("Current state")
        row = window.locator("tr").filter(has_text=Path(run.file).name)
        steps = window.locator("#kind-step > summary")
        fresh, answers = window.context.new_page(), []
        window.on("response", lambda answer: answers.append(answer))

        def is_as_if_loaded_anew() -> None:
            fresh.goto(window.url)
            if scripts:
                assert window.evaluate(SHOWN) == fresh.evaluate(SHOWN)
            else:
                window.goto(window.url)

        expect(stands).to_contain_text("33 recordings, all understood. The report is up to date.")
        expect(steps).to_contain_text("Steps · 4")
        steps.click()
        row.locator("summary").click()
        answers.clear()
        row.get_by_label("Note").fill("bumped")
        if scripts:
            row.get_by_label("Note").press("Tab")
        else:
            row.get_by_role("button", name="Save").last.click()
        expect(stands).to_contain_text("33 recordings, all understood. The report is out of date.")
        expect(window.locator(".step-list")).to_contain_text("Report out of date")
        if scripts:
            assert 0 < sum(one.request.sizes()["responseBodySize"] for one in answers) <= 10_000
            expect(row.get_by_label("Note")).to_be_visible()  # what was unfolded stays so
        is_as_if_loaded_anew()

        unfold(window)
        row.get_by_label("Kind").select_option("closed_loop")
        if not scripts:
            row.locator("details").last.locator("summary").click()
            row.get_by_role("button", name="Save").last.click()
        expect(stands).to_contain_text("33 recordings, 1 file needs you.")
        expect(steps).to_contain_text("Steps · 3")
        loops = window.locator("#kind-closed_loop")
        expect(loops.locator("> summary .chip")).to_have_text("1 to look at")
        expect(loops.locator("tr").filter(has_text=Path(run.file).name)).to_have_count(1)
        is_as_if_loaded_anew()

        if not scripts:
            unfold(window)
        if not row.get_by_role("button", name="Remove").is_visible():
            row.get_by_text(run.id, exact=True).click()
        row.get_by_role("button", name="Remove").click()
        expect(stands).to_contain_text("33 recordings, 1 file needs you.")
        expect(window.locator("#kind-unknown > summary")).to_contain_text("Not understood · 1")
        expect(loops.locator("> summary .chip")).to_have_text("understood")
        is_as_if_loaded_anew()
        assert run.id not in [one.id for one in load_submission(folder).experiments]
        # The rows behind it have other numbers now; a change still reaches the right one.
        following = load_submission(folder).experiments[index]
        unfold(window)
        row = window.locator("tr").filter(has_text=Path(following.file).name)
        if not row.get_by_label("Note").is_visible():
            row.get_by_text(following.id, exact=True).click()
        row.get_by_label("Note").fill("after")
        row.get_by_role("button", name="Save").last.click()
        until(lambda: load_submission(folder).experiments[index].note == "after")
        assert load_submission(folder).experiments[index].id == following.id


@pytest.mark.usefixtures("work_here")
def test_a_page_that_kept_its_rows_still_notices_the_changes_of_others(show, tmp_path):
    """If two people edit at once, the second save is refused; then the page shows the first."""
    folder = a_submission(tmp_path / "team", "two-cart")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        other = window.context.new_page()
        other.goto(window.url)
        unfold(window)
        unfold(other)
        for number, text in ((4, "first"), (5, "second")):  # the second save is based on the first
            window.locator(f"#row-{number} details").last.locator("summary").click()
            window.locator(f"#experiments-{number}-note").fill(text)
            window.locator(f"#experiments-{number}-note").press("Tab")
            until(lambda i=number, t=text: load_submission(folder).experiments[i].note == t)
        other.locator("#row-6 details").last.locator("summary").click()
        other.locator("#experiments-6-note").fill("other")
        other.locator("#experiments-6-note").press("Tab")
        heading = other.get_by_role("heading", level=1)
        expect(heading).to_have_text(f"{NAME} was changed meanwhile")
        other.get_by_role("link", name="Continue with the current file").click()
        expect(heading).to_have_text("team")
        expect(other.locator("#experiments-5-note")).to_have_value("second")
        other.locator("#experiments-6-note").fill("other")
        other.locator("#experiments-6-note").press("Tab")
        until(lambda: load_submission(folder).experiments[6].note == "other")
    assert [e.note for e in load_submission(folder).experiments[4:7]] == [
        "first",
        "second",
        "other",
    ]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signals")
def test_the_command_prints_its_address_and_ends_on_a_signal(tmp_path):
    """`cartlab desk` prints its address in one line, and a signal ends it with status 0.

    On a busy machine, lines of progress come first.
    """
    command = [sys.executable, "-m", "pipeline", "desk", str(tmp_path / "team"), "--no-browser"]
    with started(command, stderr=subprocess.PIPE, encoding="utf-8") as desk:
        assert desk.stderr is not None
        said = next(line for line in desk.stderr if " … " not in line)
        ready = re.fullmatch(r"ready: (http://127\.0\.0\.1:(\d+)/\S+/)\n", said)
        assert ready is not None
        with pytest.raises(HTTPError, match="403"):  # redirected, but without the cookie
            urllib.request.urlopen(ready[1], timeout=PATIENCE)
        taken = subprocess.run(
            [*command, "--port", ready[2]], stderr=subprocess.PIPE, encoding="utf-8", check=False
        )
        assert taken.returncode == 2
        assert len([line for line in taken.stderr.splitlines() if " … " not in line]) == 1
        desk.send_signal(signal.SIGTERM)
        assert desk.wait(PATIENCE) == 0
        (last,) = desk.stderr.read().splitlines()
        assert last.endswith(" ends: SIGTERM")


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("work_here")
def test_typing_goes_on_while_a_field_is_saved(show, tmp_path):
    """While one field is saved, a user can type in the next without losing letters or messages."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        window.locator("#kind-decay > summary").press("Enter")
        window.locator("#more-0 > summary").press("Enter")
        window.locator("[name='experiments.0.window']").focus()
        for text in ("0.1, 5", "my note", "", "100", ""):  # the last Tab leaves the row
            window.keyboard.type(text, delay=15)
            window.keyboard.press("Tab")

        def is_saved() -> bool:
            first = load_submission(folder).experiments[0]
            return (first.window, first.note, first.sample_rate) == ((0.1, 5), "my note", 100)

        until(is_saved)
        expect(window.get_by_text("Saved.").first).to_be_visible()


@pytest.mark.usefixtures("work_here")
@pytest.mark.parametrize("press", ["click", "hold", "during the answer"])
def test_a_press_on_remove_counts_while_a_note_is_saved(show, tmp_path, press):
    """A row is removed if Remove is pressed right after a note of it was typed.

    A long press counts too, and so does one while the note is on its way.
    """
    folder = a_submission(tmp_path / "team")
    left = [one.id for one in load_submission(folder).experiments[1:]]
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        window.locator("#kind-decay > summary").click()
        window.locator("#more-0 > summary").click()
        note = window.locator("#experiments-0-note")
        remove = window.locator("#row-0").get_by_role("button", name="Remove")
        note.press_sequentially("bumped")
        if press == "click":
            remove.click()
        elif press == "hold":
            remove.hover()
            window.mouse.down()
            window.wait_for_timeout(1_000)  # longer than an answer takes
            window.mouse.up()
        else:
            remove.evaluate("remove => { document.activeElement.blur(); remove.click(); }")
        until(lambda: [one.id for one in load_submission(folder).experiments] == left)
        expect(window.locator(f"[data-row='{left[0]}']")).to_have_id("row-0")
        expect(window.locator("details[id^=more-][open]")).to_have_count(0)
