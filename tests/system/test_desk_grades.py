"""The TA's room in a real browser: a class gone through by its keys, two at once, nobody named."""

import re
from urllib.parse import quote

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradebook.open_book import OpenBook
from tests.helpers import postgres
from tests.helpers.grades import fill_book, write_class
from tests.system import test_desk

show, fits = test_desk.show, test_desk.fits


def signed(window, name: str) -> None:
    """Say on a team's page who changes points."""
    window.get_by_label("What you change is signed").fill(name)
    with window.expect_navigation():
        window.get_by_role("button", name="Sign so").click()


def press(window, key: str) -> None:
    """Press a key that leads to another page."""
    with window.expect_navigation():
        window.keyboard.press(key)


def test_everybody_can_grade(show, tmp_path):
    """The class, a team with figures, a refusal: axe finds nothing, nothing is too wide."""
    with DeskServer(folder=write_class(tmp_path / "grades")) as server:
        window = show(server.url)
        expect(window.locator("#teams tbody tr")).to_have_count(16)
        window.get_by_text("Grade again what changed").press("Enter")
        assert fits(window)
        with window.expect_navigation():
            window.get_by_role("link", name="team-01").click()
        expect(window.locator("img.drawing").first).to_be_visible()
        assert fits(window)
        laws = window.locator("#criterion-laws")
        laws.get_by_label("Points").fill("99")
        laws.get_by_label("Reason").fill("far too many")
        with window.expect_navigation():
            laws.get_by_role("button", name="Change").click()
        expect(laws.get_by_role("alert")).to_be_visible()
        assert fits(window)


def test_a_class_is_gone_through_by_its_keys(show, tmp_path):
    """Next, previous, accept, change, within a filter; the gradebook says the same at the end."""
    grades = write_class(tmp_path / "grades")
    with DeskServer(folder=grades) as server:
        window = show(server.url)
        window.get_by_label("Looked at").select_option("no")
        window.get_by_label("Remark").select_option("hz_for_rad_s")
        expect(window.locator("#teams tbody tr")).to_have_count(5)
        teams = window.locator("#teams tbody th").all_inner_texts()
        with window.expect_navigation():
            window.get_by_role("link", name="Begin with the first").click()
        heading = window.get_by_role("heading", level=1)
        expect(heading).to_have_text(teams[0])
        signed(window, "Ada")
        press(window, "n")
        expect(heading).to_have_text(teams[1])
        press(window, "p")
        expect(heading).to_have_text(teams[0])
        press(window, "a")
        expect(heading).to_have_text(teams[1])

        window.keyboard.press("c")
        points = window.locator('input[name="points"]:focus')
        expect(points).to_be_focused()
        criterion = window.locator("article.criterion").filter(has=window.locator("[data-key=c]"))
        asked = criterion.locator('[name="criterion"]').get_attribute("value")
        window.keyboard.type("0.5")  # in place of what stood there
        window.keyboard.press("n")  # a letter in a field is a letter
        expect(points).to_have_value("0.5n")
        window.keyboard.press("Backspace")
        criterion.get_by_label("Reason").fill("the plot is clear")
        press(window, "Enter")
        expect(window.get_by_text("Noted.")).to_be_visible()
        expect(heading).to_have_text(teams[1])
        window.get_by_label("Keys:").uncheck()
        window.keyboard.press("n")
        window.reload()
        expect(heading).to_have_text(teams[1])
        window.get_by_label("Keys:").check()
        for _ in teams[1:]:
            press(window, "a")
        expect(window.locator("#teams")).to_contain_text("0 of 16")  # back at the class
    with OpenBook(grades) as book:
        assert set(book.class_now().seen.values()) == {"Ada"}
        assert len(book.class_now().seen) == len(teams)
        given = book.team(teams[1]).entry.overrides[asked]
        assert (given.points, given.why, given.by) == (0.5, "the plot is clear", "Ada")


def test_two_at_once_see_what_the_other_did(show):
    """On one database: news of the other's change comes by itself, a change over it is refused."""
    if why := postgres.missing():
        pytest.skip(why)
    with postgres.running() as place:
        fill_book(place)
        with DeskServer() as one, DeskServer() as other:
            windows = {"Ada": show(one.url), "Bob": show(other.url)}
            for name, window in windows.items():
                window.get_by_label("Folder on this computer").fill(place)
                with window.expect_navigation():
                    window.get_by_role("button", name="Open").click()
                with window.expect_navigation():
                    window.get_by_role("link", name="team-04", exact=True).click()
                signed(window, name)
            for name, window in windows.items():
                laws = window.locator("#criterion-laws")
                laws.get_by_label("Points").fill({"Ada": "1", "Bob": "2"}[name])
                laws.get_by_label("Reason").fill(f"as {name} sees it")
            ada, bob = windows.values()
            for window in (ada, bob):
                if window is bob:
                    expect(bob.locator("#news")).to_contain_text("as Ada sees it")
                with window.expect_navigation():
                    window.locator("#criterion-laws").get_by_role("button", name="Change").click()
            expect(bob.get_by_role("alert")).to_contain_text("Somebody changed this criterion")
            both = ["2", "1", "as Bob sees it", "as Ada sees it", "Bob", "Ada"]
            expect(bob.locator("tbody td")).to_have_text(both)
            assert fits(bob)
            with bob.expect_navigation():
                bob.get_by_role("link", name="Go on").click()
            expect(bob.locator("#criterion-laws .said")).to_contain_text("as Ada sees it")
        with Gradebook(place) as book:
            given = book.entry("team-04").overrides["laws"]
            assert (given.points, given.by) == (1.0, "Ada")


def test_an_anonymous_class_shows_no_name(show, tmp_path):
    """Not on the pages that a browser shows, nor in any address that it asks for."""
    grades = write_class(tmp_path / "g", anonymous=True)
    with Gradebook(grades) as book:
        real = {entry.submission for entry in book.entries()} - {"broken"}
    asked, shown = [], []
    with DeskServer(folder=grades) as server:
        window = show(server.url)
        window.on("request", lambda request: asked.append(request.url))
        window.reload()
        with window.expect_navigation():
            window.get_by_role("link", name="Begin with the first").click()
        signed(window, "Ada")
        for _ in range(3):
            shown += [window.content(), window.title()]
            expect(window.locator("#keys")).to_be_checked()
            press(window, "a")
        window.goto(server.url)
        expect(window.locator("#teams tbody tr")).to_have_count(len(real) + 1)
        shown.append(window.content())
        assert fits(window)
    for name in real:
        pattern = re.compile("|".join(map(re.escape, {name, quote(name), quote(name, safe="")})))
        assert not [text for text in asked + shown if pattern.search(text)], name
