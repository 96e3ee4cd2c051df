"""The desk from the launcher of a real JupyterLab, below the prefix of a user's server."""

import json
import os
import signal
import subprocess
import sys
import urllib.request
from importlib.metadata import entry_points
from pathlib import Path
from urllib.error import HTTPError

import psutil
import pytest
from playwright.sync_api import expect

from pipeline.submission import load_submission
from tests.helpers.places import ROOT
from tests.helpers.waiting import PATIENCE, kill, until

FILES = sorted((ROOT / "submissions" / "one-cart" / "data").iterdir())
PREFIX = "/user/ada/"


@pytest.fixture
def lab(tmp_path):
    """Start a JupyterLab for the user Ada as JupyterHub does; return process, address and token."""
    pytest.importorskip("jupyterlab", reason="JupyterLab is not installed")
    pytest.importorskip("jupyter_server_proxy", reason="jupyter-server-proxy is not installed")
    if not entry_points(group="jupyter_serverproxy_servers", name="cartlab"):
        pytest.skip(
            "cartlab is installed without its entry for Jupyter: run pip install -e . again"
        )
    folders = {
        f"JUPYTER_{what}_DIR": str(tmp_path / what) for what in ("CONFIG", "DATA", "RUNTIME")
    }
    options = [
        "--no-browser",
        "--allow-root",
        "--ServerApp.port=0",
        f"--ServerApp.base_url={PREFIX}",
    ]
    work = tmp_path / "work"
    work.mkdir()
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *options, f"--ServerApp.root_dir={work}"],
            cwd=work, env={**os.environ, **folders}, stdin=subprocess.DEVNULL, stdout=log,
            stderr=log,
        )  # fmt: skip
    try:
        until(lambda: list((tmp_path / "RUNTIME").glob("jpserver-*.json")), "JupyterLab")
        (told,) = (tmp_path / "RUNTIME").glob("jpserver-*.json")
        until(lambda: told.read_text().strip().endswith("}"), "JupyterLab's address")
        server = json.loads(told.read_text())
        yield process, server["url"].replace("localhost", "127.0.0.1"), server["token"]
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE)
        _, alive = psutil.wait_procs(children, timeout=PATIENCE)
        assert alive == []
    finally:
        kill(process)


def _status(url: str, **headers: str) -> int:
    """Send a form to an address; return the HTTP status."""
    form = urllib.request.Request(url, data=b"folder=stolen", headers=headers)
    try:
        with urllib.request.urlopen(form, timeout=PATIENCE) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


@pytest.mark.slow
@pytest.mark.sample
def test_the_desk_opens_from_the_launcher_and_only_for_its_owner(lab, browser):
    """Files, set-up, report and zip work for the owner of the server; everyone else is refused."""
    process, url, token = lab
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    context.set_default_timeout(1e3 * PATIENCE)
    window = context.new_page()
    window.goto(f"{url}lab?token={token}")
    with context.expect_page() as opened:
        window.locator(".jp-LauncherCard", has_text="cartlab").first.click()
    desk, errors = opened.value, []
    desk.on("pageerror", lambda error: errors.append(str(error)))
    desk.on(
        "requestfinished", lambda r: None if f"{PREFIX}cartlab/" in r.url else errors.append(r.url)
    )
    desk.get_by_text("Type a path").first.click()
    desk.get_by_label("Folder on this computer").fill("team")
    with desk.expect_navigation():
        desk.get_by_role("button", name="Open").click()
    assert desk.url == f"{url}cartlab/student/0/"
    desk.locator("#drop").set_input_files(FILES)
    expect(desk.locator("table.files tbody tr")).to_have_count(len(FILES))
    desk.get_by_label("Title of the report").fill("One cart")
    desk.get_by_role("button", name="Use cm").click()
    expect(desk.locator("#details").get_by_text("Saved.")).to_be_visible()
    folder = Path(psutil.Process(process.pid).cwd()) / "team"
    assert len(load_submission(folder).experiments) == len(FILES)
    desk.get_by_role("button", name="Make the report").click()
    desk.get_by_role("link", name="Read the report").click()
    frame = desk.frame_locator("iframe.page")
    expect(frame.get_by_role("heading", level=1)).to_have_text("One cart")
    assert errors == []

    (port,) = {
        one.laddr.port
        for child in psutil.Process(process.pid).children(recursive=True)
        if "pipeline.cli.jupyter" in child.cmdline()
        for one in child.net_connections()
        if one.status == psutil.CONN_LISTEN
    }
    here = f"{url}cartlab/open"
    own = url.partition("/user")[0]
    assert _status(f"http://127.0.0.1:{port}/open", Origin=f"http://127.0.0.1:{port}") == 403
    assert _status(here, Origin=own) in (401, 403)  # without a login
    assert _status(here, Origin="https://evil.example", Authorization=f"token {token}") == 403
    context.close()
