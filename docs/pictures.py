"""Make the pictures of the tutorials, the gallery and the desk; pages need Chromium."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import ViewportSize, sync_playwright

from pipeline.cli.demo import demo
from pipeline.desk.app import DeskServer
from pipeline.output import write_file
from pipeline.report.lab_report import build_document
from pipeline.report.solution.write import build_solution
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse

IMAGES = Path(__file__).parent / "images"
FIGURES = {
    "bode-cart-1": "bode.svg",
    "decay-cart-2": "decay.svg",
    "free-bodies": "free-bodies.svg",
}
# Output of `cartlab demo`: figures to copy, and pages to show in a browser.
DEMO_FIGURES = {
    "report/figures/overview.svg": "overview.svg",
    "report/figures/bode-cart-2.svg": "three-carts-bode.svg",
    "report/figures/hardware.svg": "hardware.svg",
    "gap/figures/before-after-1.svg": "before-after.svg",
    "gap/figures/effect-1.svg": "effect.svg",
}
DEMO_PAGES = {
    "report/report.html": "report-page.png",
    "grades/class.html#mistakes": "class-page.png",
    "grades/feedback/team-2/feedback.html": "feedback-page.png",
    "gap/gap.html": "gap-page.png",
}
WINDOW: ViewportSize = {"width": 1000, "height": 760}


def main() -> None:
    """Write every picture."""
    with tempfile.TemporaryDirectory() as folder:
        tutorials(Path(folder) / "bench-4")
        demo(Path(folder) / "demo")
        gallery(Path(folder) / "demo")
        desk(Path(folder) / "bench-4", Path(folder) / "demo" / "grades")
        exploration(Path(folder) / "bench-5")


def tutorials(out: Path) -> None:
    """Draw figures of a bench that is simulated as in the tutorials."""
    bench = prepare_bench(
        preset="throne-2dof", model=None, hide=["coulomb_friction:cart=2,force=0.002"]
    )
    write_submission(out, bench, seed=7, reported=False)
    analysis = analyse(load_submission(out))
    for document in (build_document(analysis), build_solution(analysis)):
        for picture in document.pictures():
            if picture.name in FIGURES:
                write_file(IMAGES / FIGURES[picture.name], picture.svg)


def gallery(made: Path) -> None:
    """Copy the demo's figures and take pictures of its pages."""
    for figure, name in DEMO_FIGURES.items():
        shutil.copyfile(made / figure, IMAGES / name)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = browser.new_page(viewport=WINDOW)
        for file, name in DEMO_PAGES.items():
            page.goto(f"{made.as_uri()}/{file}")
            page.screenshot(path=IMAGES / name)
        browser.close()


def exploration(team: Path) -> None:
    """Take a picture of a virtual bench that explores itself, once the page gives its reasons."""
    command = [sys.executable, "-m", "pipeline", "emulate", "--preset", "throne-1dof"]
    options = ["--hide", "coulomb_friction", "--speed", "8"]
    with (
        subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True) as bench,
        DeskServer(folder=team) as server,
        sync_playwright() as playwright,
    ):
        assert bench.stderr is not None
        try:
            address = next(line.split()[-1] for line in bench.stderr if line.startswith("ready: "))
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
            page = browser.new_page(viewport=WINDOW)
            page.goto(server.url)
            page.get_by_role("link", name="Bench", exact=True).click()
            page.get_by_text("Explore: the bench records").click()
            page.locator("#explore-port").select_option(address)
            page.get_by_label("Accuracy to reach, ± %").fill("0.01")
            page.get_by_role("button", name="Explore").click()
            page.locator("#thought:not([hidden])").wait_for(timeout=1e5)
            page.locator("#status", has_text="Recording").wait_for(timeout=1e5)
            page.wait_for_timeout(1e3)
            page.locator(".kicker").first.evaluate("it => { it.textContent = 'lab/bench-5' }")
            page.screenshot(path=IMAGES / "desk-explore.png")
            browser.close()
        finally:
            bench.terminate()


def desk(team: Path, grades: Path) -> None:
    """Take pictures of a team's files and next experiment, a graded team, and a new exercise."""
    with DeskServer(folder=team) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        page = browser.new_page(viewport=WINDOW)
        page.goto(server.url)
        page.locator(".kicker").evaluate("it => { it.textContent = 'lab/bench-4' }")  # a short path
        page.screenshot(path=IMAGES / "desk.png")
        own = "kind=sine&amplitude=0.01&frequency=3&seconds=20&goal=zeta_2"
        page.goto(f"{server.url.rsplit('/', 2)[0]}/bench/0/weigh?{own}")
        page.get_by_text("What would cartlab have chosen?").click()
        page.locator("#brings").scroll_into_view_if_needed()
        page.screenshot(path=IMAGES / "desk-lesson.png")
        page.goto(f"{server.url.rsplit('/', 2)[0]}/")
        page.get_by_role("link", name="Desk", exact=True).click()
        page.get_by_text("Type a path").click()
        page.get_by_label("Folder on this computer").fill(str(grades))
        page.get_by_role("button", name="Open").click()
        page.get_by_role("link", name="team-2", exact=True).click()
        page.get_by_role("link", name="Frequencies from the Bode fit").click()
        page.locator("figure, svg, img").first.wait_for()
        page.screenshot(path=IMAGES / "desk-team.png")
        page.goto(f"{server.url.rsplit('/', 2)[0]}/exercises/?effect=coulomb_friction")
        page.locator("#hidden img").scroll_into_view_if_needed()
        page.screenshot(path=IMAGES / "desk-exercises.png")
        browser.close()


if __name__ == "__main__":
    main()
