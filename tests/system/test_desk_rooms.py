"""The desk's pages for the bench and for instructors, in a real browser."""

import re

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.grading.rubric_file import load_rubric
from pipeline.submission import load_submission
from tests.helpers.acquisitions import sine, write_work
from tests.helpers.benches import emulator
from tests.helpers.desks import a_recorded_cart
from tests.helpers.grades import write_class_of_two
from tests.helpers.waiting import until
from tests.system import test_desk
from tests.system.test_report_pages import PHONE, WIDE

show, fits = test_desk.show, test_desk.fits
pytestmark = pytest.mark.usefixtures("all_work_here")


@pytest.mark.slow
@pytest.mark.sample
def test_a_session_is_watched_and_steered(show, tmp_path, real, monkeypatch):
    """Buttons keep one run and end another, and the session still goes on to its end."""
    monkeypatch.chdir(tmp_path)
    work = write_work(
        tmp_path / "team",
        [
            sine("long", seconds=300),
            sine("next", seconds=1),
            sine("last", seconds=300),
            sine("short", seconds=1),
        ],
    )
    with DeskServer() as server:
        window = show(server.url, size=PHONE)
        with window.expect_navigation():
            window.get_by_role("link", name="Choose a folder to record into").press("Enter")
        assert fits(window)
        with window.expect_navigation():
            window.get_by_role("button", name="Record here team").press("Enter")
        expect(window.get_by_text("0 of 4 recorded. Next: long.")).to_be_visible()
        assert fits(window)
        window.get_by_label("Port of the bench").first.select_option(real.address)  # virtual
        for name in ("long", "next", "last"):
            window.get_by_label(name, exact=True).check()
        window.get_by_role("button", name="Start recording").click()

        status, stop = window.locator("#status"), window.get_by_role("button", name="Stop")
        expect(status).to_have_text("Recording long.")
        expect(stop).to_be_in_viewport()
        expect(window.locator("#plots .keys").first).to_contain_text(re.compile(r"cart 1 [−\d]"))
        assert fits(window)
        window.locator("#told").scroll_into_view_if_needed()
        expect(stop).to_be_in_viewport()  # always in reach
        window.get_by_role("button", name="Keep this partial recording").click()
        expect(window.locator("#plan .done b")).to_have_text(["long", "next"])
        expect(status).to_have_text("Recording last.")
        window.reload()
        expect(status).to_have_text("Recording last.")
        window.keyboard.press("Escape")
        expect(status).to_have_text("The session is over.")
        until(lambda: (work / "data" / "last.partial.txt").exists())
        over = window.get_by_role("button", name="Session over")
        expect(over).to_be_disabled()
        expect(window.get_by_role("button", name="Skip")).to_be_hidden()
        assert fits(window)
        expect(window.locator(".controls").get_by_role("link", name="Files")).to_be_visible()
        window.get_by_role("link", name="Current plan").click()
        expect(window.get_by_text("Stopped. Start again")).to_be_visible()
        row = window.get_by_role("row").filter(has_text="last")
        expect(row).to_contain_text("next")
        expect(row).to_contain_text("An earlier try ended early")
        window.get_by_text("2 recorded").click()
        expect(window.get_by_role("row").filter(has_text="long")).to_contain_text("recorded")
        assert fits(window)
        assert window.locator("#port").input_value() == real.address  # remembered
        window.get_by_label("short", exact=True).press("Space")
        window.get_by_role("button", name="Start recording").press("Enter")
        expect(over).to_be_disabled()
        window.get_by_role("link", name="Files").click()
        expect(window.get_by_role("heading", level=1)).to_have_text("team")
    assert [e.id for e in load_submission(work).experiments] == ["long", "next", "short"]


@pytest.mark.slow
@pytest.mark.sample
def test_an_exploration_is_watched_and_steered(show, tmp_path):
    """In an exploration you can veto an experiment, add your own, and end with Esc.

    The diary shows each of these decisions.
    """
    work = a_recorded_cart(tmp_path / "team")
    with emulator("--speed", "8", preset="throne-1dof") as bench, DeskServer(folder=work) as server:
        window = show(server.url, size=PHONE)
        with window.expect_navigation():
            window.get_by_role("link", name="Bench").click()
        assert fits(window)
        window.get_by_text("Explore: the bench records").click()
        window.locator("#explore-port").select_option(bench.address)
        window.get_by_label("Parameter to find").select_option(label="the damping ratio ζ")
        window.get_by_label("Accuracy to reach, ± %").fill("0,0001")
        window.get_by_label("Accuracy to reach, ± %").press("Enter")  # Enter works like the button

        thought = window.locator("#thought")
        expect(thought).to_contain_text(re.compile(r"^ζ is known .* The next recording is \S+:"))
        chosen = re.search(r"The next recording is (\S+):", thought.inner_text())
        assert chosen is not None
        window.get_by_role("button", name="Veto").click()
        window.get_by_text("Add your own experiment").click()
        window.get_by_label("Amplitude").fill("20")
        window.get_by_role("button", name="Add it to the plan").click()
        expect(window.get_by_role("alert")).to_contain_text("amplitude: expected at most the limit")
        window.get_by_label("Amplitude").fill("0.02")
        window.get_by_label("Duration").fill("120")
        window.get_by_role("button", name="Add it to the plan").click()
        expect(window.get_by_text("step-5 is in the plan")).to_be_visible()
        expect(window.locator("#plan .now b")).to_have_text("step-5")
        expect(thought).to_contain_text("step-5, which was added by hand")
        diary = window.frame_locator("#diary")
        expect(diary.locator("#turns")).to_contain_text(f"{chosen[1]} was vetoed")
        expect(diary.locator("#errors svg")).to_be_visible()
        assert fits(window)
        window.keyboard.press("Escape")
        expect(window.locator("#status")).to_have_text("The session is over.")
        window.get_by_role("link", name="Current plan").click()
        window.get_by_role("link", name="Diary of the exploration").click()
        expect(window.locator("#turns")).to_contain_text("step-5, which was added by hand")
    assert chosen[1] not in {e.id for e in load_submission(work).experiments}


@pytest.mark.slow
@pytest.mark.sample
def test_an_exercise_has_the_chosen_effect(show, tmp_path):
    """An instructor ticks an effect, moves its slider, and makes an exercise from it."""
    out = tmp_path / "exercise"
    with DeskServer() as server:
        window = show(server.url, size=WIDE)
        with window.expect_navigation():
            window.get_by_role("link", name="New exercise").click()
        window.locator('input[value="coulomb_friction"]').check()
        drawn = window.locator("#hidden img")
        expect(drawn).to_have_js_property("complete", True)
        until(lambda: drawn.evaluate("image => image.naturalWidth") > 100)
        before = drawn.get_attribute("src")
        slider = window.get_by_label("force, from a tenth")
        slider.fill("0.5")
        until(lambda: window.locator("#hidden img").get_attribute("src") != before)
        expect(window.locator("#hidden li")).to_contain_text("coulomb_friction on cart 1")
        expect(window.locator("#result")).to_have_text("1 effect is hidden in throne-2dof.")
        expect(window.get_by_label("Masses")).to_be_hidden()  # only a custom chain has this field
        assert fits(window)
        window.get_by_label("Folder").fill(str(out))
        window.get_by_role("button", name="Make it").click()
        expect(window.get_by_text("The exercise is ready:")).to_be_visible()
        expect(window.locator(".previews svg").first).to_be_visible()
        told = window.get_by_text("coulomb_friction on cart 1")
        expect(told).to_be_hidden()
        window.get_by_text("Hidden effects (1), shown only to you").click()
        expect(told).to_be_visible()
        assert fits(window)
        window.get_by_role("button", name="Open as a submission exercise").click()
        expect(window.get_by_role("heading", level=1)).to_have_text("exercise")
    assert len(load_submission(out).experiments) > 10


@pytest.mark.slow
@pytest.mark.sample
def test_a_rubric_is_edited_by_keyboard(show, tmp_path, monkeypatch):
    """A rubric is copied from a shipped one, changed, checked and saved by keyboard."""
    monkeypatch.chdir(tmp_path)
    write_class_of_two(tmp_path / "graded")
    path = tmp_path / "lab.toml"
    with DeskServer(folder=tmp_path / "graded") as server:
        window = show(server.url, size=PHONE)
        window.goto(f"{window.url.split('/grades')[0]}/rubric/")
        assert fits(window)
        window.get_by_role("link", name="Start from throne-1dof").focus()
        with window.expect_navigation():
            window.keyboard.press("Enter")
        result = window.locator(".now .result")
        expect(result).to_have_text("20 points in 14 criteria; fits submissions with 1 cart")
        window.get_by_label("Save as").fill(str(path))
        text = window.locator("#text")
        good = text.input_value()
        text.fill(good.replace("\npoints", "\npionts", 1))
        wrong = window.locator(".listing .bad").filter(has_text="unknown key; did you mean")
        expect(wrong.first).to_be_visible()
        expect(result).to_contain_text(re.compile(r"^Line \d+: "))
        assert fits(window)
        text.fill(good)
        expect(result).to_contain_text("20 points")
        expect(wrong).to_have_count(0)
        window.get_by_label("Deduction for each day begun").fill("50")
        window.get_by_label("Students see").press("ArrowDown")
        assert fits(window)
        window.get_by_role("button", name="Show the preview").focus()
        with window.expect_navigation():
            window.keyboard.press("Enter")
        expect(result).to_contain_text("1 of 2 teams would have different points.")
        drawn = window.locator("img.drawing")
        until(lambda: drawn.evaluate("image => image.naturalWidth") > 100)
        assert fits(window)
        assert not path.exists()
        window.get_by_role("button", name="Save the rubric").focus()
        with window.expect_navigation():
            window.keyboard.press("Enter")
        expect(window.locator(".now .chip")).to_have_text("Saved")
        expect(
            window.get_by_role("heading", name="Grade graded again with this rubric")
        ).to_be_visible()
        assert fits(window)
        rubric = load_rubric(path)
        assert (rubric.late.percent_per_day, rubric.students.see) == (50, "check")


@pytest.mark.slow
@pytest.mark.sample
def test_a_picture_of_an_effect_is_drawn_on_a_phone(show):
    """On a phone an effect's picture is drawn once its row is opened."""
    with DeskServer() as server:
        window = show(server.url)
        window.goto(f"{window.url}effects/")
        window.set_viewport_size({"width": 400, "height": 800})
        window.locator("#coulomb_friction summary").click()
        drawn = window.locator("#coulomb_friction img")
        until(lambda: drawn.evaluate("image => image.naturalWidth") > 100)
        assert fits(window)


@pytest.mark.slow
@pytest.mark.sample
def test_on_a_phone_checkboxes_stay_beside_their_labels(show, tmp_path, monkeypatch):
    """On a phone, no label of an effect is broken apart from its checkbox."""
    monkeypatch.chdir(tmp_path)
    with DeskServer() as server:
        window = show(server.url, size=PHONE)
        window.goto(f"{window.url}exercises/")
        labels = window.locator(".flags > label")
        expect(labels.first).to_be_visible()
        pieces = labels.evaluate_all("all => all.map((one) => one.getClientRects().length)")
        assert pieces == [1] * labels.count()
        assert fits(window)
