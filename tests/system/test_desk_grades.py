"""The TA's pages in a real browser: grading a class by keys, two TAs at once, anonymous names."""

import shutil

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.gradebook import Gradebook
from tests.helpers import postgres
from tests.helpers.grades import fill_book, write_class
from tests.helpers.grading_students import write_team
from tests.system import test_desk

show, fits = test_desk.show, test_desk.fits
LAPTOP = 1280, 720
REASON = "the plot is clear"


def signed(window, name: str) -> None:
    """Enter a name on a team's page as the author of changes."""
    window.get_by_text("Changes are signed").click()
    window.get_by_label("Your name").fill(name)
    with window.expect_navigation():
        window.get_by_role("button", name="Use this name").click()


def press(window, key: str) -> None:
    """Press a key that leads to another page."""
    with window.expect_navigation():
        window.keyboard.press(key)


@pytest.mark.slow
@pytest.mark.sample
def test_the_grading_pages_are_accessible(show, tmp_path):
    """Class page, team page and a refused change are accessible (axe) and fit the screen."""
    with DeskServer(folder=write_class(tmp_path / "grades")) as server:
        window = show(server.url)
        expect(window.locator("#teams tbody tr")).to_have_count(16)
        for folded in window.locator("#work summary").all():
            folded.press("Enter")
        assert fits(window)
        with window.expect_navigation():
            window.get_by_role("link", name="teams without a flag").click()
        expect(window.locator("[name=team]")).to_have_count(8)
        assert fits(window)
        window.go_back()
        with window.expect_navigation():
            window.get_by_role("link", name="team-02", exact=True).click()
        expect(window.get_by_text("stands in team-03 too")).to_be_visible()
        with window.expect_navigation():
            window.get_by_role("link", name="Frequencies from the Bode fit").click()
        expect(window.locator("img.drawing").first).to_be_visible()
        assert fits(window)
        # Tab reaches the same fields without the letter keys.
        window.get_by_label("Another number of points").fill("99")
        window.get_by_label("Reason, which the team reads").fill("far too many")
        with window.expect_navigation():
            window.get_by_role("button", name="Save").click()
        expect(window.locator("#chosen").get_by_role("alert")).to_be_visible()
        expect(window.get_by_label("Another number of points")).to_have_value("99")
        assert fits(window)


@pytest.mark.slow
@pytest.mark.sample
def test_a_class_is_graded_by_keys(show, tmp_path):
    """Keys change points for one team, or for all teams with a flag; each change can be undone."""
    grades = write_class(tmp_path / "grades")
    with DeskServer(folder=grades) as server:
        window = show(server.url, size=LAPTOP)
        on_screen = window.get_by_role("link", name="Continue with broken")
        expect(on_screen).to_be_in_viewport()  # the result and the next action come first
        window.get_by_role("link", name="Hz where rad/s is asked").press("Enter")
        expect(window.locator("#teams tbody tr")).to_have_count(5)
        teams = window.locator("#teams tbody th").all_inner_texts()
        window.get_by_role("link", name="Start with the first").press("Enter")
        heading = window.get_by_role("heading", level=1)
        expect(heading).to_have_text(teams[0])
        signed(window, "Ada")
        press(window, "n")
        expect(heading).to_have_text(teams[1])
        press(window, "p")
        expect(heading).to_have_text(teams[0])
        press(window, "a")
        expect(heading).to_have_text(teams[1])
        expect(window.get_by_role("status").first).to_have_text(f"{teams[0]}: accepted.")

        chosen, title = window.locator(".criteria [aria-current]"), window.locator("#chosen-title")
        first = title.inner_text()
        press(window, "j")
        expect(title).not_to_have_text(first)
        press(window, "k")
        expect(title).to_have_text(first)
        while "ound recordings" not in chosen.inner_text():
            press(window, "j")
        window.keyboard.press("3")
        window.keyboard.type("the plot is cleara1n")  # a letter typed in a field is no command
        for _ in range(3):
            window.keyboard.press("Backspace")
        for needed in ("#chosen-title", ".points :checked + span", ".decide .main", "#why"):
            expect(window.locator(needed)).to_be_in_viewport(ratio=1)
        press(window, "Enter")
        said = window.locator("#chosen").get_by_role("status")
        expect(said).to_have_text("Saved.")  # beside the changed points
        expect(said).to_be_in_viewport()
        expect(chosen).to_contain_text("0.5 / 1")

        press(window, "e")
        rows = window.locator("#list tbody tr")
        expect(rows).to_have_count(5 - 1)  # without the one team that has all points
        expect(window.get_by_label("Comment, which the teams read")).to_have_value(REASON)
        expect(rows.nth(1).locator("td").nth(1)).to_have_text("0.5")
        assert fits(window)
        window.keyboard.press("4")
        expect(rows.nth(1).locator("td").nth(1)).to_have_text("0.75")  # shown but not yet applied
        rows.nth(0).get_by_role("checkbox").press("Space")
        window.get_by_label("Comment, which the teams read").focus()
        press(window, "Enter")
        expect(window.get_by_text("3 teams changed")).to_be_visible()
        assert fits(window)
        with Gradebook(grades) as book:
            given = [book.entry(one).overrides.get("data") for one in teams]
        assert [one.points for one in given if one and one.text == REASON].count(0.75) == 3
        press(window, "u")
        expect(window.get_by_text("3 teams undone")).to_be_visible()
        press(window, "a")
        expect(heading).to_have_text(teams[1])

        window.keyboard.press("?")
        expect(window.get_by_text("apply to everybody")).to_be_in_viewport()
        window.keyboard.press("Escape")
        press(window, "u")
        expect(window.get_by_role("button", name="Redo")).to_be_visible()
        press(window, "u")
        expect(window.get_by_role("button", name="Undo")).to_be_visible()
        while "Everything else that the lab asks for" not in title.inner_text():
            press(window, "k")
        window.keyboard.press("u")
        expect(window.get_by_text("Nothing was changed by hand here.")).to_be_in_viewport()
        for line in window.locator(".criteria .title").all():
            assert line.evaluate("one => one.scrollWidth <= one.clientWidth")
        window.keyboard.press("?")
        window.get_by_label("Keys are on").uncheck()
        window.keyboard.press("n")
        window.reload()
        expect(heading).to_have_text(teams[1])
        window.keyboard.press("n")
        expect(heading).to_have_text(teams[1])
        window.get_by_text("Keys", exact=True).click()
        window.get_by_label("Keys are on").check()
    with Gradebook(grades) as book:
        seen = [one.reviewed_by for one in book.class_now().entries if one.reviewed_by]
        assert seen == ["Ada"]
        given = {one: book.entry(one).overrides.get("data") for one in teams}
    (own,) = [one for one in given.values() if one]
    assert (own.points, own.text, own.by) == (0.5, REASON, "Ada")


@pytest.mark.slow
@pytest.mark.sample
def test_two_tas_see_each_others_changes(show):
    """If two TAs change one class, each sees the other's change, and no change is lost."""
    if why := postgres.missing():
        pytest.skip(why)
    with postgres.running() as place:
        fill_book(place)
        with DeskServer() as one, DeskServer() as other:
            windows = {"Ada": show(one.url), "Bob": show(other.url)}
            for name, window in windows.items():
                window.get_by_text("Type a path").click()
                window.get_by_label("Folder on this computer").fill(place)
                with window.expect_navigation():
                    window.get_by_role("button", name="Open").click()
                with window.expect_navigation():
                    window.get_by_role("link", name="team-04", exact=True).click()
                signed(window, name)
                with window.expect_navigation():
                    window.get_by_role("link", name="The final table is possible").click()
            for name, window in windows.items():
                number = {"Ada": "1", "Bob": "2"}[name]
                window.get_by_label("Another number of points").fill(number)
                window.get_by_label("Reason, which the team reads").fill(f"as {name} sees it")
            ada, bob = windows.values()
            for window in (ada, bob):
                if window is bob:
                    expect(bob.locator("#news")).to_contain_text("as Ada sees it")
                with window.expect_navigation():
                    window.get_by_role("button", name="Save").click()
            expect(bob.get_by_role("alert")).to_contain_text("Somebody changed this criterion")
            both = ["2", "1", "as Bob sees it", "as Ada sees it", "Bob", "Ada"]
            expect(bob.locator("tbody td")).to_have_text(both)
            assert fits(bob)
            with bob.expect_navigation():
                bob.get_by_role("link", name="Continue with").click()
            expect(bob.locator("#chosen .hand")).to_contain_text("as Ada sees it")
        with Gradebook(place) as book:
            given = book.entry("team-04").overrides["laws"]
            assert (given.points, given.by) == (1.0, "Ada")


@pytest.mark.slow
@pytest.mark.sample
def test_chosen_files_stay_when_another_field_is_wrong(show, tmp_path, monkeypatch):
    """After a wrong field, the form to grade a class keeps the chosen files and what was typed."""
    monkeypatch.chdir(tmp_path)
    handed_in = tmp_path / "team-1.zip"
    team = write_team(tmp_path / "team-1", 1)
    shutil.make_archive(str(team), "zip", team.parent, team.name)
    with DeskServer() as server:
        window = show(server.url)
        window.goto(f"{window.url}grading/")
        files, rubric = window.locator("#files"), window.get_by_label("Rubric")
        files.set_input_files(handed_in)
        rubric.fill("no-such-rubric")
        window.get_by_role("button", name="Grade").click()
        expect(window.locator("#rubric-wrong")).to_be_visible()
        expect(window.locator("#files-wrong")).to_have_count(0)
        assert files.evaluate("one => one.files[0].name") == handed_in.name
        expect(rubric).to_have_value("no-such-rubric")
        rubric.fill("throne-1dof")
        window.get_by_role("button", name="Grade").click()
        window.wait_for_url("**/grades/0/**")
        expect(window.locator("#teams tbody tr")).to_have_count(1)
    assert (tmp_path / "grades" / "handed-in" / handed_in.name).is_file()
