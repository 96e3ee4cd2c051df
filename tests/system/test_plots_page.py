"""The page of plots in a browser: by keyboard, on a phone, in dark mode."""

import re

import pytest
from playwright.sync_api import expect

from pipeline.desk.app import DeskServer
from pipeline.report.compare import render_page
from pipeline.report.compared_runs import compare_runs
from pipeline.words.progress import silent
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.desks import a_submission
from tests.helpers.waiting import PATIENCE, until
from tests.system.test_desk import fits, show  # noqa: F401  (a fixture)
from tests.system.test_report_pages import PHONE, WIDE

INK = "canvas => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
INK_SUM = f"canvas => ({INK})(canvas).reduce((a, b) => a + b, 0)"
DRAWN = f"canvases => canvases.map(c => ({INK})(c).some(v => v > 0))"


def shown(window) -> str:
    """Return the part of the address that says what is shown."""
    return window.evaluate("location.hash")


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("work_here")
def test_runs_and_models_are_compared_by_keyboard(show, tmp_path):  # noqa: F811
    """By keyboard a student compares two runs, then views one cart's residual and spectrum."""
    folder = a_submission(tmp_path / "team", "two-cart")
    with DeskServer(folder=folder) as server:
        window = show(server.url)
        window.get_by_role("button", name="Compare recordings and models").click()
        framed = window.frame_locator("iframe").locator("body")
        expect(framed.locator(".result")).to_contain_text("The linear model fits worst in")
        window.get_by_role("link", name="Back to the files").click()
        window.locator("#kind-step > summary").click()
        window.get_by_role("link", name="Larger plot of step-2").click()
        expect(framed.locator("#told")).to_have_text("step-2: position")
        assert fits(window)
        window.get_by_role("link", name="Without this frame").click()
        window.wait_for_url("**/report/compare.html#run=step-2")
        window.goto(window.url.partition("#")[0])
        expect(window.locator(".result")).to_contain_text("The linear model fits worst in")
        assert window.locator("canvas").evaluate_all(DRAWN) == [True, True]  # one plot per cart

        # Press keys to show a second run, one of the two carts, the residual and its spectrum.
        window.get_by_role("checkbox", name="step-2").focus()
        window.keyboard.press("Space")
        window.get_by_role("checkbox", name="x₂").focus()
        window.keyboard.press("Space")
        assert window.locator("canvas").count() == 1
        window.get_by_role("radio", name="Overlay").focus()
        window.keyboard.press("ArrowRight")
        expect(window.locator("#told")).to_have_text("step-1, step-2: residual")
        assert shown(window) == "#run=step-1&run=step-2&cart=1&show=residual"
        plot = window.get_by_role("group", name="x₁, residual")
        plot.focus()
        for _ in range(3):
            window.keyboard.press("ArrowRight")
        read = window.locator("output")
        expect(read).to_contain_text(re.compile(r"^[\d.]+ s step-1: linear model"))
        before = read.text_content()
        window.keyboard.press("+")
        window.keyboard.press("ArrowRight")
        assert read.text_content() != before
        window.keyboard.press("0")
        window.get_by_role("radio", name="Residual", exact=True).focus()
        window.keyboard.press("ArrowRight")
        expect(window.get_by_role("group", name="x₁, amplitude")).to_be_visible()
        assert window.locator("canvas").evaluate_all(DRAWN) == [True]
        expect(window.locator(".key li")).to_have_count(4)

        # A number in the table opens its residual, and the address of a view opens that view again.
        window.get_by_role("link", name=re.compile("residual of sweep, x₂, linear model")).click()
        expect(window.locator("#told")).to_have_text("sweep: residual")
        address = window.url
        window.goto("about:blank")
        window.goto(address)
        expect(window.get_by_role("checkbox", name="sweep")).to_be_checked()
        expect(window.get_by_role("group", name="x₂, residual")).to_be_visible()
        expect(window.get_by_role("group", name="x₁, residual")).to_have_count(0)

        assert fits(window)
        window.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
        width = "document.querySelector('canvas').getBoundingClientRect().width"
        until(lambda: 300 < window.evaluate(width) < PHONE[0])

        kept = (folder / "report" / "compare.html").stat()
        window.goto(re.sub(r"report/.*", "compare", address))
        expect(framed.locator(".result")).to_be_visible()
        assert (folder / "report" / "compare.html").stat().st_mtime_ns == kept.st_mtime_ns
        (folder / "data" / "step-1.csv").touch()
        window.goto(re.sub(r"report/.*", "compare", address))
        window.get_by_role("button", name="Make the plots").click()
        expect(framed.locator(".result")).to_be_visible()
        assert (folder / "report" / "compare.html").stat().st_mtime_ns != kept.st_mtime_ns


@pytest.mark.parametrize("size", [WIDE, PHONE], ids=["wide", "phone"])
def test_buttons_and_values_stand_below_their_plot(browser, tmp_path, size):
    """The buttons, the key and the values of a plot are below it and cover no other plot.

    When the system turns dark, the plots take the dark colours.
    """
    analysis = make_analysis(2)
    runs = compare_runs(analysis, gap=None, progress=silent)
    page = tmp_path / "compare.html"
    page.write_text(render_page(analysis, runs, gap=None, report=False), encoding="utf-8")
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, color_scheme="light"
    )
    window = context.new_page()
    window.set_default_timeout(1e3 * PATIENCE)
    window.goto(page.as_uri())

    stages = window.locator(".stage")
    assert stages.count() == 2
    for k in range(stages.count()):
        stages.nth(k).focus()
        window.keyboard.press("ArrowRight")
    expect(window.locator("output").last).to_contain_text(" s ")
    boxes = window.locator(".stage, .key, .tools button, output").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect()).map(r => [r.top, r.bottom, r.right])"
    )
    per = len(boxes) // stages.count()
    for first in range(0, len(boxes), per):
        (_, bottom, _), *below = boxes[first : first + per]
        assert all(top >= bottom - 0.5 for top, _, _ in below)
        after = boxes[first + per][0] if first + per < len(boxes) else float("inf")
        assert all(low <= after + 0.5 and right <= size[0] for _, low, right in below)
    light = window.locator("canvas").first.evaluate(INK_SUM)
    window.emulate_media(color_scheme="dark")
    until(lambda: window.locator("canvas").first.evaluate(INK_SUM) != light)
    context.close()


def test_without_scripts_there_is_a_picture_and_the_table(browser, tmp_path):
    """Without scripts the page shows the worst run as a picture, and the errors of every run."""
    analysis = make_analysis(1)
    runs = compare_runs(analysis, gap=None, progress=silent)
    page = tmp_path / "compare.html"
    page.write_text(render_page(analysis, runs, gap=None, report=False), encoding="utf-8")
    context = browser.new_context(java_script_enabled=False)
    window = context.new_page()
    window.set_default_timeout(1e3 * PATIENCE)
    window.goto(page.as_uri())

    expect(window.get_by_role("img", name="Measured motion")).to_be_visible()
    expect(window.get_by_role("table")).to_contain_text("linear model")
    assert not window.get_by_role("checkbox").first.is_visible()
    context.close()
