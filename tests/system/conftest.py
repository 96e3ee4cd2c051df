"""A real browser, which the tests of pages share."""

import shutil

import pytest

from tests.helpers.waiting import PATIENCE

# chromium-headless-shell needs less than half of the processor time of chromium.
CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium")
FLAGS = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking"


@pytest.fixture(scope="package")
def browser():
    """Return a real browser; tests that need it are skipped if no browser is installed."""
    if CHROMIUM is None:
        pytest.skip("no chromium: apt-get install chromium-headless-shell")
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=1e3 * PATIENCE)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS.split(), timeout=1e3 * PATIENCE
        )
        yield browser
        browser.close()
