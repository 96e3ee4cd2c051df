"""Fixtures shared by the tests."""

import shutil
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.waiting import PATIENCE

# The same examples every time, and no verdict on how fast a busy machine is.
settings.register_profile(
    "cartlab", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cartlab")

# Real measurements may be used in place but not passed on, so they lie outside the project.
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

CHROMIUM = shutil.which("chromium")
# A shell starts what runs in the background deaf to Ctrl-C, and its children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

FLAGS = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking"


@pytest.fixture(scope="module")
def browser():
    """A real browser; where there is none, what needs it skips."""
    if CHROMIUM is None:
        pytest.skip("no chromium on the path: apt-get install chromium")
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=1e3 * PATIENCE)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS.split(), timeout=1e3 * PATIENCE
        )
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real measurements; tests that need it skip where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"real measurements are not here ({REAL_DATA})")
    return REAL_DATA
