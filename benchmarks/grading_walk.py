"""Grade a class at the desk, from the zip of a learning platform to released feedback.

    python -m benchmarks.grading_walk [--teams 120] [--doubtful 10]

A browser uploads a class as Moodle packs it, and starts the grading. It accepts the teams without a
remark together, reviews the others one by one, and changes the points of every second one. Then it
releases the feedback and exports it for Moodle. The command prints the clicks, and the minutes in
which a person waits for the machine. A file that is chosen counts as two clicks.
"""

import argparse
import io
import shutil
import tempfile
import time
import zipfile
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.desk.app import DeskServer
from pipeline.simulated.submission import Students, write_submission
from pipeline.submission.load import NAME

PRESET = "throne-1dof"
_PATIENCE = 1_800_000.0  # ms; the page itself says if the grading ends early


@dataclass(kw_only=True)
class Walk:
    """What the walk took: clicks, and seconds of waiting for the machine.

    Attributes
    ----------
    exported, remarks : names of the files in the exported zip, and what cartlab says about it.
    """

    clicks: int = 0
    grading: float = 0.0
    export: float = 0.0
    exported: tuple[str, ...] = ()
    remarks: str = ""


def pack_class(path: Path, *, teams: int, doubtful: int) -> None:
    """Write a class as Moodle packs it; the doubtful teams reported a frequency in Hz."""
    with tempfile.TemporaryDirectory() as scratch, zipfile.ZipFile(path, "w") as packed:
        for n in range(teams):
            folder = Path(scratch) / f"team-{n:03d}"
            students = Students(authors=(f"s{n}",))
            write_submission(folder, PRESET, seed=n, compact=True, reported=True, students=students)
            if n < doubtful:
                _report_in_hertz(folder / NAME)
            account = f"Student {n:03d}_{1000 + n}_assignsubmission_file_"
            for file in sorted(file for file in folder.rglob("*") if file.is_file()):
                inside = file.relative_to(folder.parent).as_posix()
                packed.write(file, f"{account}/{inside}", zipfile.ZIP_DEFLATED)


def _report_in_hertz(toml: Path) -> None:
    lines = toml.read_text(encoding="utf-8").split("\n")
    at = max(n for n, line in enumerate(lines) if line.startswith("omega_n = "))
    lines[at] = f"omega_n = {float(lines[at].split('=')[1]) / 6.283185:.3g}"
    toml.write_text("\n".join(lines), encoding="utf-8")


def walk(window: Any, url: str, packed: Path, *, doubtful: int) -> Walk:
    """Grade a class in a browser window, and count.

    Parameters
    ----------
    window : a page of Playwright.
    """
    done = Walk()

    def click(*, link: str = "", button: str = "", at: str = "") -> None:
        done.clicks += 1
        role, name = ("link", link) if link else ("button", button)
        (window.locator(at) if at else window.get_by_role(role, name=name)).first.click()

    def fill(at: str, text: str) -> None:
        click(at=at)
        window.locator(at).fill(text)

    window.goto(url)
    click(link="Grade submissions")
    done.clicks += 2  # in the dialog of the browser
    window.set_input_files("#files", packed)
    fill("#rubric", PRESET)
    began = time.monotonic()
    click(button="Grade")
    window.wait_for_selector("#teams, [role=alert]", timeout=_PATIENCE)
    done.grading = time.monotonic() - began

    click(link="without a flag")
    click(button="Accept the ticked teams")
    click(link="Continue with")
    for n in range(doubtful):
        if n % 2:
            click(at=".points label:nth-of-type(2)")
            fill("#why", "The unit was wrong, the method was right.")
            click(button="Save")
        click(button="Accept")
    click(button="Publish grades")
    click(at="summary:text('To a learning platform')")
    done.clicks += 2  # to open the list, and to choose
    window.select_option("#lms", "moodle")
    began = time.monotonic()
    with window.expect_download(timeout=_PATIENCE) as download:
        click(button="Export feedback files")
    done.export = time.monotonic() - began
    with zipfile.ZipFile(download.value.path()) as files:
        if "remarks.txt" in files.namelist():  # remarks of the export, and the platform's zip
            done.remarks = files.read("remarks.txt").decode()
            exported = io.BytesIO(files.read("feedback-moodle.zip"))
        else:
            exported = download.value.path()
    with zipfile.ZipFile(exported) as files:
        done.exported = tuple(files.namelist())
    return done


def main() -> None:
    """Walk from the zip to the feedback, and print the counts."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--teams", type=int, default=120)
    parser.add_argument("--doubtful", type=int, default=10)
    asked = parser.parse_args()
    browser = shutil.which("chromium-headless-shell") or shutil.which("chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        packed = Path(folder) / "class.zip"
        pack_class(packed, teams=asked.teams, doubtful=asked.doubtful)
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        with chdir(folder), DeskServer() as server:
            window = chromium.new_page()
            done = walk(window, server.url, packed, doubtful=asked.doubtful)
        chromium.close()
    feedback = sum(name.endswith("feedback.html") for name in done.exported)
    print(f"{asked.teams} teams, {asked.doubtful} doubtful: {done.clicks} clicks")
    print(f"machine: grading {done.grading / 60:.1f} min, export {done.export / 60:.1f} min")
    print(f"feedback of {feedback} teams exported")
    print(done.remarks, end="")


if __name__ == "__main__":
    main()
