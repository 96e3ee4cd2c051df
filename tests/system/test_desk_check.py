"""A student checks reported numbers in a real browser, from the files to the zip, by keyboard."""

import re

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.grading.self_check.answers import read_answers
from tests.helpers.desks import a_submission
from tests.system import test_desk
from tests.system.test_report_pages import PHONE

show, fits = test_desk.show, test_desk.fits
pytestmark = pytest.mark.usefixtures("all_work_here")


@pytest.mark.slow
@pytest.mark.sample
def test_a_student_finds_and_corrects_a_wrong_number(show, tmp_path):
    """The check shows which number is wrong and where to look; the corrected number agrees."""
    folder = a_submission(tmp_path / "team")
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8").replace("omega_n = 13.1", "omega_n = 2.085", 1)
    path.write_text(text.replace("[system]", '[students]\nsee = "check"\n\n[system]', 1), "utf-8")
    with DeskServer(folder=folder) as server:
        window = show(server.url, size=PHONE)
        link = window.get_by_role("link", name="Check", exact=False).first
        link.focus()
        with window.expect_navigation():
            window.keyboard.press("Enter")
        result = window.locator(".now .result")
        expect(result).to_have_text("Your numbers are not checked yet.")
        assert fits(window)
        window.get_by_role("button", name="Check my numbers").focus()
        window.keyboard.press("Enter")
        expect(result).to_contain_text("disagree")
        row = window.get_by_role("row").filter(has_text=re.compile("ω.*first estimate"))
        expect(row).to_contain_text("2.085")
        assert fits(window)
        row.get_by_role("button", name="Where should I look").focus()
        window.keyboard.press("Enter")
        expect(row).to_contain_text("Hz where rad/s is asked")
        expect(window.get_by_text("run 2 times.")).to_be_visible()
        assert fits(window)
        new = path.read_text(encoding="utf-8").replace("omega_n = 2.085", "omega_n = 13.1", 1)
        path.write_text(new, encoding="utf-8")
        window.reload()
        expect(result).to_have_text("Something changed since the last check.")
        window.get_by_role("button", name="Check my numbers").click()
        expect(result).to_contain_text("agree with your own recordings")
        expect(window.get_by_role("link", name="Hand in").first).to_be_visible()
        assert fits(window)
    assert [one.stage for one in read_answers(folder)] == ["which", "where", "which"]
