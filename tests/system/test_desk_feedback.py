"""A student asks about a grade and the TA answers, in a real browser, by keyboard alone."""

import socket
from pathlib import Path

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.gradebook import Gradebook
from tests.helpers.desks import PROXY, through_proxy
from tests.helpers.grades import write_class
from tests.system import test_desk
from tests.system.test_report_pages import PHONE

show, fits, walk_to = test_desk.show, test_desk.fits, test_desk.walk_to
USERS = """
[[users]]
name = "s4"
role = "student"
grades = [{ gradebook = "grades", submission = "team-04" }]
[[users]]
name = "Ada"
role = "ta"
gradebooks = ["grades"]
[[users]]
name = "prof"
role = "instructor"
gradebooks = ["grades"]
"""


@pytest.fixture
def lab(tmp_path):
    """Start a desk that browsers reach through a proxy, and yield its address."""
    write_class(tmp_path / "grades")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    site = f"http://127.0.0.1:{port}"
    users = tmp_path / "users.toml"
    users.write_text(PROXY.replace("https://Lab.example.edu", site) + USERS, encoding="utf-8")
    users.chmod(0o600)
    with DeskServer(port=port, users=users):
        yield site


def named(name: str) -> dict[str, str]:
    """Return the headers that the proxy adds."""
    return through_proxy(0, name).headers


def press(window, control, key: str = "Enter") -> None:
    """Walk to a control that leads to another page, and press it."""
    walk_to(window, control)
    with window.expect_navigation():
        window.keyboard.press(key)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("work_here")
def test_from_the_request_to_the_answer_by_keyboard(show, lab, tmp_path: Path):
    """By keyboard, a student asks about a grade, the TA answers, and the student reads it."""
    prof = show(f"{lab}/", extra_http_headers=named("prof"))
    press(prof, prof.get_by_role("button", name="Publish grades"))
    expect(prof.get_by_role("status")).to_contain_text("The grades are published.")

    student = show(f"{lab}/", size=PHONE, color_scheme="dark", extra_http_headers=named("s4"))
    expect(student.locator(".result")).to_have_text("16.99 of 20 points")
    laws = student.locator("#criterion-laws")
    walk_to(student, laws.locator("summary"))
    student.keyboard.press("Enter")
    walk_to(student, laws.get_by_label("What was judged wrongly"))
    student.keyboard.type("Page 3 has the laws.")
    assert fits(student)
    press(student, laws.get_by_role("button"))
    expect(laws.locator(".chip")).to_have_text("waits for an answer")
    expect(laws).to_contain_text("Page 3 has the laws.")
    assert fits(student)

    ada = show(f"{lab}/", extra_http_headers=named("Ada"))
    press(ada, ada.get_by_role("link", name="1 regrade request waits"))
    expect(ada.locator("article")).to_contain_text("Page 3 has the laws.")
    assert fits(ada)
    walk_to(ada, ada.get_by_role("combobox", name="Points"))
    ada.keyboard.type("1")
    walk_to(ada, ada.get_by_label("Answer, which the team reads"))
    ada.keyboard.type("You are right.")
    press(ada, ada.get_by_role("button", name="Answer"))
    expect(ada.locator(".result")).to_have_text("No request waits for an answer")
    walk_to(ada, ada.locator("summary"))
    ada.keyboard.press("Enter")
    expect(ada.locator("details")).to_contain_text("Ada answered: 1 point")
    assert fits(ada)

    student.reload()
    expect(laws.locator(".chip")).to_have_text("answered")
    expect(laws.locator("summary")).to_contain_text("1 of 1")
    expect(laws).to_contain_text("You are right.")
    assert fits(student)
    press(student, student.get_by_role("link", name="The whole feedback"))
    expect(student.locator("body")).to_contain_text("You are right.")
    with Gradebook(tmp_path / "grades") as book:
        given = book.entry("team-04").overrides["laws"]
        assert (given.points, given.text, given.by) == (1.0, "You are right.", "Ada")
