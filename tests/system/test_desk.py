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
from pipeline.submission import load_submission
from pipeline.submission.load import NAME
from tests.helpers.accessibility import violations
from tests.helpers.desks import a_submission
from tests.helpers.places import ROOT
from tests.helpers.waiting import PATIENCE, started, until
from tests.system.test_report_pages import PHONE, WIDE

FILES = sorted((ROOT / "submissions" / "one-cart" / "data").iterdir())


@pytest.fixture
def show(browser):
    """Open a desk in a window of its own; errors and requests to elsewhere fail the test."""
    contexts, errors = [], []

    def opened(url: str, *, size=WIDE, **options):
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce", **options
        )
        context.set_default_timeout(1e3 * PATIENCE)
        contexts.append(context)
        window = context.new_page()
        window.on("pageerror", lambda error: errors.append(str(error)))
        window.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        home = re.match(r"http://[^/]+/", url)
        assert home is not None
        own = (home[0], "blob:", "data:")
        window.on("request", lambda r: None if r.url.startswith(own) else errors.append(r.url))
        window.goto(url)
        assert re.fullmatch(r"http://[^/]+/(\w+/0/)?", window.url)  # without the secret
        return window

    yield opened
    for context in contexts:
        context.close()
    said = "the server responded with a status of (422|409)"  # on the page
    # A page may be asking something when its test ends the desk; both the browser and htmx say so.
    ended = r"net::ERR_(CONNECTION_\w+|INCOMPLETE_CHUNKED_ENCODING|EMPTY_RESPONSE)"
    ended += "|htmx:(afterRequest|sendError|sendAbort)"
    assert [error for error in errors if not re.search(f"{said}|{ended}", error)] == []


def fits(window) -> bool:
    """Tell whether nothing is wider than a screen, and axe finds nothing by day and by night.

    It looks at the phone's, on which more has to be scrolled to and touched.
    """
    own, overhang = window.viewport_size, []
    for width, height in (WIDE, PHONE):
        window.set_viewport_size({"width": width, "height": height})
        overhang.append(window.evaluate("document.documentElement.scrollWidth") - width)
    assert violations(window) == []
    window.set_viewport_size(own)
    return max(overhang) <= 0


def test_a_student_goes_from_an_empty_folder_to_the_zip(show, tmp_path):
    """Files dropped, a mistake mended, the form, the report, the zip."""
    folder = tmp_path / "team"
    with DeskServer() as server:
        window = show(server.url)
        window.get_by_label("Folder on this computer").fill(str(folder))
        with window.expect_navigation():  # to a page that has its scripts, which take the files
            window.get_by_role("button", name="Open").click()
        expect(window.get_by_role("heading", level=1)).to_have_text("team")

        window.locator("#drop").set_input_files(FILES)
        expect(window.locator("table.files tbody tr")).to_have_count(len(FILES))
        assert len(load_submission(folder).experiments) == len(FILES)

        window.get_by_label("Title of the report").fill("One <b>cart</b>")
        window.get_by_label("Unit of positions").fill("cm")
        window.get_by_text("The controller you are asked for").click()
        window.get_by_label("Cart whose position").fill("2")
        save = window.locator("#details").get_by_role("button", name="Save")
        save.click()
        expect(window.locator("#design-cart-wrong")).to_contain_text("there is no cart 2")
        expect(window.get_by_label("Title of the report")).to_have_value("One <b>cart</b>")
        window.get_by_label("Cart whose position").fill("1")
        save.click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        step = next(e for e in load_submission(folder).experiments if e.kind == "step")
        row = window.get_by_role("row").filter(has_text=Path(step.file).name)
        row.get_by_text(step.id, exact=True).click()
        row.get_by_label("Note").fill("the cart was bumped")
        row.get_by_role("button", name="Save").click()
        until(lambda: "bumped" in (folder / NAME).read_text(encoding="utf-8"))
        window.get_by_role("button", name="Make the report").click()
        expect(window.locator("[data-events]")).to_contain_text("The report")
        window.reload()
        window.get_by_role("link", name="Read the report").click()
        report = window.frame_locator("iframe")
        expect(report.get_by_role("heading", level=1)).to_have_text("One <b>cart</b>")
        expect(report.locator("figure .tools").first).to_be_attached()  # its own script runs
        window.get_by_role("link", name="Back to the files").click()
        window.get_by_label("Title of the report").fill("Two carts")
        window.locator("#details").get_by_role("button", name="Save").click()
        expect(window.get_by_text("The report is out of date")).to_be_visible()
        window.get_by_role("button", name="Hand in", exact=True).click()
        expect(window.get_by_text("The report in the zip is of the files")).to_be_visible()
        assert "Two carts" in (folder / "report" / "report.html").read_text(encoding="utf-8")
        assert fits(window)
        with window.expect_download() as download:
            window.get_by_role("link", name="Download the zip").click()
        with zipfile.ZipFile(download.value.path()) as archive:
            assert {NAME, "notes.md", "report/report.pdf"} <= set(archive.namelist())
    submission = load_submission(folder)
    assert submission.title == "Two carts"
    assert "bumped" in next(e for e in submission.experiments if e.id == step.id).note


@pytest.mark.usefixtures("work_here")
def test_what_is_typed_stays_until_it_is_saved(show, tmp_path):
    """Another form is saved, a row taken out, a form refused as outdated: what was typed stands."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        title, details = window.get_by_label("Title of the report"), window.locator("#details")
        title.fill("typed")
        details.get_by_role("checkbox").first.uncheck()
        window.locator("#row-1 summary").click()
        note = window.locator("#experiments-1-note")
        note.evaluate("note => { note.value = 'bumped' }")  # typed, and the row not left
        window.locator("#row-0 summary").click()
        window.locator("#row-0").get_by_role("button", name="Take it out").click()
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
        window.get_by_role("link", name="Go on").click()
        expect(heading).to_have_text("team")
        expect(title).to_have_value("typed")
        details.get_by_role("button", name="Save").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
    submission = load_submission(folder)
    assert (submission.title, submission.system.springs[0]) == ("typed", False)


def test_what_is_made_of_the_file_waits_for_what_is_not_saved(show, tmp_path):
    """Zip and report are held and say so; they go on where it is saved, or all the same."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        asked = []
        window.on("request", lambda request: asked.append(request.url.rsplit("/", 1)[1]))
        title, held = window.get_by_label("Title of the report"), window.get_by_role("alert")
        title.fill("typed")
        for section, name, role in (
            ("#hand-in", "Hand in", "button"),
            ("#report", "Make the report", "button"),
            ("#report", "Look for what", "button"),
        ):
            within = window.locator(section)
            shown = within.get_by_role("alert").count()
            within.get_by_role(role, name=name).first.click()
            expect(within.get_by_role("alert")).to_have_count(shown + 1)
        assert not {"hand-in", "make-report", "make-gap"}.intersection(asked)
        assert violations(window) == []
        window.get_by_role("button", name="hand in without it").click()  # all the same
        with window.expect_download() as download:
            window.get_by_role("link", name="Download the zip").click()
        with zipfile.ZipFile(download.value.path()) as archive:
            assert "typed" not in archive.read(NAME).decode()

        window.get_by_role("link", name="Back to the files").click()
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
        title.fill("typed again")
        window.get_by_role("button", name="Make it anew").click()
        window.get_by_role("button", name="go on without it").click()
        expect(window.locator("[data-events]")).to_contain_text("The report")
        expect(title).to_have_value("typed again")


@pytest.mark.usefixtures("work_here")
def test_everybody_can_use_it(show, tmp_path):
    """Axe finds nothing by day and by night; nothing is wider than the screen; keys do."""
    folder = a_submission(tmp_path / "team", "two-cart")
    with DeskServer(folder=folder) as server:
        window = show(server.url, size=PHONE)
        table = window.locator(".wide").filter(has=window.locator("table.files"))
        assert table.evaluate("it => it.scrollWidth <= it.clientWidth")  # nor sideways in it
        window.get_by_label("Position of one encoder count").fill("0")
        window.get_by_label("Position of one encoder count").press("Enter")
        expect(window.locator("#system-position-per_count-wrong")).to_be_visible()
        for details in window.locator("#details details:not([open]) > summary").all():
            details.press("Enter")
        assert fits(window)
        for page in ("student/0/report", ""):
            window.goto(f"{window.url.split('student')[0]}{page}")
            assert fits(window)
        window.keyboard.press("Tab")
        expect(window.get_by_role("link", name="Skip to the content")).to_be_focused()


@pytest.mark.usefixtures("work_here")
def test_without_scripts_it_works_too(show, tmp_path):
    """Every change is a plain form."""
    folder = a_submission(tmp_path / "team")
    with DeskServer(folder=folder) as server:
        window = show(server.url, java_script_enabled=False)
        window.get_by_label("Title of the report").fill("Plain")
        window.locator("#details").get_by_role("button", name="Save").click()
        expect(window.get_by_text("Saved.")).to_be_visible()
        window.locator("#drop").set_input_files([FILES[0]])
        window.get_by_role("button", name="Take", exact=True).click()
        expect(window.get_by_text("is there already")).to_be_visible()
    assert load_submission(folder).title == "Plain"


def test_the_command_says_its_address_and_ends_with_a_signal(tmp_path):
    """One line when ready, one where the port is taken; a signal ends it by name, status 0."""
    command = [sys.executable, "-m", "pipeline", "desk", str(tmp_path / "team"), "--no-browser"]
    with started(command, stderr=subprocess.PIPE, encoding="utf-8") as desk:
        assert desk.stderr is not None
        ready = re.fullmatch(r"ready: (http://127\.0\.0\.1:(\d+)/\S+/)\n", desk.stderr.readline())
        assert ready is not None
        with pytest.raises(HTTPError, match="403"):  # led on without its cookie
            urllib.request.urlopen(ready[1], timeout=PATIENCE)
        taken = subprocess.run(
            [*command, "--port", ready[2]], stderr=subprocess.PIPE, encoding="utf-8", check=False
        )
        assert taken.returncode == 2
        assert len(taken.stderr.splitlines()) == 1
        number = signal.SIGINT if sys.platform == "win32" else signal.SIGTERM
        desk.send_signal(number)
        assert desk.wait(PATIENCE) == 0
        assert desk.stderr.read() == f"cartlab: the desk ends: {number.name}\n"
