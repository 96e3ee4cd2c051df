"""A real browser, which the tests of pages share."""

import re
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


@pytest.fixture
def open_window(browser):
    """Open an address in a new window; script errors and requests to other hosts fail the test."""
    contexts, errors = [], []

    def opened(url: str, *, size=(1280, 900), **options):
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce", **options
        )
        context.set_default_timeout(1e3 * PATIENCE)
        contexts.append(context)
        window = context.new_page()
        window.on("pageerror", lambda error: errors.append(str(error)))
        window.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        own = (f"{url.split('/', 3)[0]}//{url.split('/', 3)[2]}/", "blob:", "data:")
        window.on("request", lambda r: None if r.url.startswith(own) else errors.append(r.url))
        window.goto(url)
        return window

    yield opened
    for context in contexts:
        context.close()
    said = "the server responded with a status of (422|409)"  # refusals that a page shows
    # A page may have a request open when its test ends the server; browser and htmx then report
    # errors.
    ended = r"net::ERR_(CONNECTION_\w+|INCOMPLETE_CHUNKED_ENCODING|EMPTY_RESPONSE)"
    ended += "|htmx:(afterRequest|sendError|sendAbort)"
    assert [error for error in errors if not re.search(f"{said}|{ended}", error)] == []
