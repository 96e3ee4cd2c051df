"""The live page: who may see it, what it shows, and that it never delays a recording."""

import http.client
import json
import logging
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import expect

from pipeline.bench.events import Anomalies, RunOutcome
from pipeline.bench.live_page import LivePage
from pipeline.bench.live_state import LiveState
from pipeline.errors import ConfigError, HardwareError
from pipeline.experiments.plan import Plan, PlanLimits, Recording, StateLoop
from pipeline.protocol import HEARTBEAT_EVERY, Reading
from tests.helpers.accessibility import violations
from tests.helpers.acquisitions import decay, sine, write_work
from tests.helpers.benches import emulator
from tests.helpers.waiting import PATIENCE, address, started, until
from tests.system.test_report_pages import PHONE, WIDE

DUTY, COUNT, TITLE = 1e-4, 0.002, "Bench <9> & co"  # V, cm
SUBMISSION = f"""
version = 1
title = "{TITLE}"
[system]
carts = 2
input = {{ unit = "V", per_count = {DUTY} }}
position = {{ unit = "cm", per_count = {COUNT} }}
"""
SINE = sine("sine-01", seconds=10, settle=3.0)
DECAY = decay("decay-1", seconds=10, settle=1.0)
LOOP = Recording(
    id="control", kind="closed_loop", carts=(1, 2), wave="square", amplitude=1.0, frequency=0.2,
    controller=StateLoop(cart=2),
)  # fmt: skip


@pytest.fixture
def state(folder) -> LiveState:
    """Return what a page keeps, while the second of three recordings runs."""
    state = LiveState(folder)
    state.planned(PLAN, frozenset({"decay-1"}))
    state.started(SINE)
    return state


PLAN = Plan(limits=PlanLimits(input=0.4, travel=2.5), recordings=(DECAY, SINE, LOOP))


def lines(first: int, last: int) -> list[Reading]:
    """Return the lines that a bench sends between two times in ms."""
    return [
        Reading(counts=(ms, -ms), target=100, duty=round(100 * np.sin(0.0126 * ms)), ms=ms)
        for ms in range(first, last)
    ]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "submission.toml").write_text(SUBMISSION, encoding="utf-8")
    return tmp_path


@pytest.fixture
def page(folder) -> Iterator[LivePage]:
    """Yield a live page with a plan, of which one run is done."""
    with LivePage(LiveState(folder)) as page:
        page.session.planned(PLAN, frozenset({"decay-1"}))
        yield page


# ------------------------------------------------------------------------ what the page keeps


def test_points_are_thinned_in_units_and_of_this_run(state):
    """The page gets every fifth line, in volts and centimetres; a new run clears the old points.

    A page that did not ask for a minute then gets only the last twelve seconds.
    """
    state.readings(lines(0, 1000), Anomalies(lost=2))
    found = state.points(run=0, start=0)
    assert (found["run"], found["start"], found["end"], len(found["points"])) == (1, 0, 200, 200)
    assert found["points"][10] == (0.05, round(100 * np.sin(0.63)) * DUTY, 0.01, 0.1, -0.1)
    assert found["counters"] == {
        "lines": 1000, "lost": 2, "garbled": 0, "late": 0, "resets": 0, "stuck": 0,
    }  # fmt: skip
    state.readings(lines(1000, 1010), Anomalies(lost=2))
    assert [p[0] for p in state.points(run=1, start=200)["points"]] == [1.0, 1.005]

    state.started(LOOP)
    state.readings(lines(0, 1), Anomalies())
    fresh = state.points(run=1, start=202)
    assert fresh["run"] == 2
    assert fresh["points"] == [(0.0, 0.0, 0.2, 0.0, 0.0)]  # 0.2 cm: the target of 100 counts

    state.started(SINE)
    for second in range(60):
        state.readings(lines(1000 * second, 1000 * second + 1000), Anomalies())
    found = state.points(run=3, start=10)
    assert (found["end"], len(found["points"])) == (12_000, 2400)
    assert found["points"][0][0] == 48.0


def test_the_plan_shows_the_state_of_each_recording(state):
    """The plan shows the state of each recording, and for a partial one the reason."""
    assert [e["state"] for e in state.snapshot()["plan"]] == ["done", "now", "to come"]
    assert state.snapshot()["seconds_left"] == 13.0 + 8.0
    state.finished(RunOutcome(recording=SINE, lines=5, partial="cable pulled"))
    entry = state.snapshot()["plan"][1]
    assert (entry["state"], entry["why"]) == ("partial", "cable pulled")
    state.finished(RunOutcome(recording=SINE, lines=9000, remarks=("slow clock",)))
    assert state.snapshot()["plan"][1]["state"] == "done"
    assert state.snapshot()["remarks"] == ["sine-01: slow clock"]


def test_an_instruction_waits_for_its_own_answer(state):
    """An instruction waits until it is answered by its number, or until the page ends."""
    assert not state.answer(1)
    waiting = threading.Thread(target=state.confirm, args=("hold",))
    waiting.start()
    until(lambda: state.snapshot()["instruction"] == {"number": 1, "text": "hold"})
    assert not state.answer(7)
    assert state.answer(1)
    waiting.join()
    assert state.snapshot()["instruction"] is None
    threading.Timer(0.1, state.end).start()
    with pytest.raises(ConfigError, match=r"nobody.*: let go"):
        state.confirm("let go")


# ------------------------------------------------------------------------- who may see it


def ask(page: LivePage, path: str = "", method: str = "GET", body: str | None = None, **headers):
    """Make one request, as any program could; return the response and its text."""
    url = urlsplit(page.url)
    connection = http.client.HTTPConnection(url.hostname or "", url.port or 0, timeout=PATIENCE)
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    connection.request(
        method, path if path.startswith("/") else url.path + path, body=body, headers=named
    )
    response = connection.getresponse()
    text = response.read().decode()
    connection.close()
    return response, text


def news(page: LivePage, opened: ExitStack) -> http.client.HTTPResponse:
    """Open the page's stream of events, which is closed with `opened`."""
    url = urlsplit(page.url)
    connection = http.client.HTTPConnection(url.hostname or "", url.port or 0, timeout=PATIENCE)
    opened.callback(connection.close)
    connection.request("GET", f"{url.path}events")
    return opened.enter_context(closing(connection.getresponse()))


def test_the_page_is_served_to_this_computer_only(page, folder):
    """Only this computer can open the page, which loads only its own scripts and is not cached.

    A port in use is an error.
    """
    assert urlsplit(page.url).hostname == "127.0.0.1"
    response, text = ask(page)
    assert response.status == 200
    policy = response.headers["Content-Security-Policy"]
    for part in ("default-src 'none'", "script-src 'self'", "style-src 'self'"):
        assert part in policy.split("; ")
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert response.headers["Referrer-Policy"] == "no-referrer"
    assert response.headers["Cache-Control"] == "no-store"
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert "//" not in text  # nothing from another host
    named = re.findall(r'(?:href|src)="([^"]+)"', text)
    assert {"live.js", "live.css", "report.css"} < set(named)
    for name in named:
        assert ask(page, name)[0].status == 200
    with pytest.raises(HardwareError, match="not free"):
        LivePage(LiveState(folder), port=urlsplit(page.url).port or 0)


def test_the_secret_is_new_each_time_and_never_written(folder, caplog, capfd):
    """Each live page has a new secret, which no log line and no printed line contains."""
    caplog.set_level(logging.DEBUG)
    secrets = set()
    for _ in range(2):
        with LivePage(LiveState(folder)) as page:
            ask(page)
            ask(page, "press", "POST", "", Origin="http://evil.example")
            secrets.add(urlsplit(page.url).path.strip("/"))
    assert len(secrets) == 2
    assert all(len(secret) >= 32 for secret in secrets)
    written = caplog.text + "".join(capfd.readouterr())
    assert not any(secret in written for secret in secrets)


def test_every_other_request_is_refused(page):
    """Without the secret, or from another host, origin or site, every address gets 403.

    A malformed, unknown or overlong answer confirms nothing, and the page still works.
    """
    path, port = urlsplit(page.url).path, urlsplit(page.url).port
    good, done = f"http://127.0.0.1:{port}", "wish=done&number=1"
    for other in ("/", "/x/", path[:-2] + "/", path[:-1], "/events", "/live.js", f"/x{path}"):
        response, text = ask(page, other)
        assert response.status == 403, other
        assert path.strip("/") not in text
    assert ask(page, "../../secret")[0].status in (403, 404)
    assert ask(page, "submission.toml")[0].status == 404
    for status, headers in (
        (403, {"Host": f"evil.example:{port}"}), (403, {"Host": "127.0.0.1"}),
        (200, {"Host": f"localhost:{port}"}), (403, {"Origin": "http://evil.example"}),
        (403, {"Origin": "null"}), (403, {"Origin": good, "Host": f"localhost:{port}"}),
        (403, {"Sec_Fetch_Site": "cross-site"}),
    ):  # fmt: skip
        assert ask(page, **headers)[0].status == status, headers
    assert ask(page, "press", "POST", done)[0].status == 403
    for status, body in (
        (400, ""), (400, "[1]"), (400, "wish=done"), (400, "wish=done&number=x"), (409, done),
        (409, "wish=burn&number=1"), (413, "1" * 500),
    ):  # fmt: skip
        assert ask(page, "press", "POST", body, Origin=good)[0].status == status, body
    assert ask(page)[0].status == 200


def test_a_page_gets_events_and_a_ninth_page_is_refused(page):
    """A page first gets the whole state, then new points; a ninth page gets 503."""
    with ExitStack() as opened:
        stream, *_ = [news(page, opened) for _ in range(8)]
        assert stream.headers["Content-Type"].startswith("text/event-stream")
        assert stream.readline() == b"event: state\n"
        state = json.loads(stream.readline().removeprefix(b"data: "))
        assert (state["title"], state["units"]) == (TITLE, {"position": "cm", "input": "V"})
        page.session.started(SINE)
        page.session.readings(lines(0, 50), Anomalies())
        while not stream.readline().startswith(b"event: points"):
            pass
        points = json.loads(stream.readline().removeprefix(b"data: "))
        assert points["points"][0] == [0.0, 0.0, 0.01, 0.0, 0.0]
        assert ask(page, "events")[0].status == 503


def test_idle_connections_share_a_fixed_number_of_places(page, monkeypatch):
    """One more connection without the secret ends the oldest; those with the secret stay."""
    monkeypatch.setattr("pipeline.web._MOST_STRANGERS", 4)
    monkeypatch.setattr("pipeline.web._STRANGER_STAYS", 10 * PATIENCE)
    url = urlsplit(page.url)
    with ExitStack() as opened:
        stream = news(page, opened)
        strangers = [
            opened.enter_context(socket.create_connection((url.hostname, url.port), PATIENCE))
            for _ in range(5)
        ]
        with suppress(ConnectionResetError):
            assert strangers[0].recv(1) == b""
        assert ask(page)[0].status == 200
        assert stream.readline() == b"event: state\n"


def test_a_full_queue_does_not_keep_the_owner_out(page, monkeypatch):
    """An owner who waits in a queue full of idle connections is still served."""
    url, held, go_on = urlsplit(page.url), threading.Event(), threading.Event()
    snapshot = page.session.snapshot

    def slow() -> object:
        held.set()
        assert go_on.wait(PATIENCE)
        return snapshot()

    monkeypatch.setattr(page.session, "snapshot", slow)
    with ExitStack() as opened:
        threading.Thread(target=news, args=(page, opened), daemon=True).start()
        assert held.wait(PATIENCE)  # the server's loop is blocked
        rightful = socket.create_connection((url.hostname, url.port), timeout=PATIENCE)
        opened.enter_context(rightful)
        rightful.sendall(f"GET {url.path} HTTP/1.1\r\nHost: {url.netloc}\r\n\r\n".encode())
        for _ in range(200):  # more than the queue holds
            stranger = opened.enter_context(socket.socket())
            stranger.setblocking(False)
            stranger.connect_ex((url.hostname, url.port))
        go_on.set()
        assert rightful.recv(12) == b"HTTP/1.1 200"


def test_the_page_does_not_delay_a_run(folder):
    """With two browsers that read and one that does not, 50 lines take less than a heartbeat."""
    took = []
    with ExitStack() as opened:
        with LivePage(LiveState(folder)) as page:
            news(page, opened)
            readers = [threading.Thread(target=news(page, opened).read) for _ in range(2)]
            for reader in readers:
                reader.start()
            page.session.started(SINE)
            for k in range(0, 2000, 50):
                batch = lines(k, k + 50)
                began = time.perf_counter()
                page.session.readings(batch, Anomalies())
                took.append(time.perf_counter() - began)
                time.sleep(0.02)  # the time that a bench needs for 50 lines
        for reader in readers:
            reader.join()
    assert np.median(took) < HEARTBEAT_EVERY


def test_pages_get_the_end_of_the_session(folder, monkeypatch):
    """When the session ends, each open page gets the last state, and the port is freed.

    A connection without the secret is closed after a time before; one with the secret stays.
    """
    monkeypatch.setattr("pipeline.web._STRANGER_STAYS", 0.2)
    with ExitStack() as opened:
        with LivePage(LiveState(folder)) as page:
            page.session.planned(PLAN, frozenset())
            stream = news(page, opened)
            url = urlsplit(page.url)
            with socket.create_connection((url.hostname, url.port), timeout=PATIENCE) as stranger:
                with suppress(ConnectionResetError):
                    assert stranger.recv(1) == b""
        text = stream.read().decode()
    assert '"phase":"over"' in text
    with pytest.raises(ConnectionRefusedError):
        ask(page)


# --------------------------------------------------------------------------- in the browser


@pytest.fixture
def show(open_window, page):
    """Open the page in a new window."""

    def opened(**options):
        window = open_window(page.url, **options)
        expect(window.locator("#title")).to_have_text(TITLE)
        return window

    return opened


def record(page: LivePage) -> None:
    """Show the page 3 s of rest and two seconds of a sine."""
    page.session.settling(SINE, 3.0)
    page.session.started(SINE)
    page.session.readings(lines(0, 2000), Anomalies(lost=3))


INK = """(id) => {
  const canvas = document.querySelector(`#${id} canvas`);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const colours = new Set();
  for (let i = 0; i < data.length; i += 4)
    if (data[i + 3] === 255) colours.add([data[i], data[i + 1], data[i + 2]].join());
  return [...colours];
}"""
BLUE, ORANGE = "0,114,178", "213,94,0"


def test_the_page_shows_plan_progress_counters_and_curves(page, show):
    """The page shows the plan, progress, counters, and curves in the colours of their labels.

    If the system switches to dark mode, the curves of the open page change colour.
    """
    window = show(color_scheme="light")
    record(page)

    expect(window.locator("#status")).to_have_text("Recording sine-01.")
    expect(window.locator("#plan .now b")).to_have_text("sine-01")
    expect(window.locator("#plan .done b")).to_have_text("decay-1")
    expect(window.locator("#left")).to_have_text("16 s left")  # 21 s - 3 s of rest - 2 s of sine
    expect(window.locator(".counters .bad")).to_have_text("lost3")
    expect(window.locator(".counters")).to_contain_text("lines2000")
    expect(window.locator("#plots .keys").first).to_contain_text("cart 1 3.99")
    expect(window.locator("#plots .keys").first).to_contain_text("cart 2 −3.99")
    assert {BLUE, ORANGE} <= set(window.evaluate(INK, "positions"))
    assert BLUE in window.evaluate(INK, "inputs")
    assert ORANGE not in window.evaluate(INK, "inputs")
    window.emulate_media(color_scheme="dark")
    until(lambda: "86,180,233" in window.evaluate(INK, "positions"))
    assert BLUE not in window.evaluate(INK, "positions")

    page.session.finished(RunOutcome(recording=SINE, lines=2000, partial="a cart passed the limit"))
    expect(window.locator("#plan .partial .why")).to_have_text("a cart passed the limit")
    page.session.started(LOOP)
    expect(window.locator("#plots .keys").first).to_contain_text("target")


def test_the_carts_move_as_they_are_measured(page, show):
    """The drawing follows the last point, and a held cart says so."""
    window = show()
    page.session.started(SINE)
    page.session.readings(lines(0, 1000), Anomalies())
    carts, shifts = window.locator("#carts g"), r"translate\((.*) 0\)"
    expect(carts).to_have_count(2)
    expect(carts.first).to_have_attribute("transform", re.compile(r"translate\(1[56]"))
    drawn = [carts.nth(i).get_attribute("transform") or "" for i in range(2)]
    found = [float(re.sub(shifts, r"\1", text)) for text in drawn]
    assert found == pytest.approx([110 + 50, 290 - 50], abs=1)  # px: the motion is equal
    expect(window.locator("#carts .spring")).to_have_count(3)
    expect(window.locator("#carts .held")).to_have_count(1 if len(SINE.carts) == 1 else 0)
    page.session.started(DECAY.model_copy(update={"carts": (2,)}))
    expect(window.locator("#carts .held")).to_have_text("1 held")


@pytest.mark.parametrize("how", ["click", "Enter"])
def test_an_instruction_is_confirmed_with_its_button(page, show, how):
    """An instruction appears with the focus on its button, and disappears once it is confirmed."""
    window = show()
    done = threading.Event()

    def asked() -> None:
        page.session.confirm("hold cart 2; pull cart 1 out")
        done.set()

    threading.Thread(target=asked).start()
    expect(window.get_by_role("alert")).to_have_text("hold cart 2; pull cart 1 out")
    button = window.get_by_role("button", name="Done")
    expect(button).to_be_focused()
    if how == "click":
        button.click()
    else:
        window.keyboard.press(how)
    assert done.wait(PATIENCE)
    expect(window.locator("#ask")).to_be_hidden()


def test_only_buttons_that_have_an_effect_are_enabled(page, show):
    """Skip, Keep and Repeat work once in each run; Stop works always, also by Esc."""
    window = show()
    skip = window.get_by_role("button", name="Skip")
    expect(skip).to_be_disabled()
    page.session.buttons.begin()
    page.session.buttons.offer("skip", "keep", "repeat")
    record(page)
    window.get_by_role("button", name="Keep this partial recording").click()
    until(lambda: page.session.buttons.pressed == "keep")
    expect(skip).to_be_disabled()

    page.session.buttons.begin()
    page.session.buttons.offer("repeat", "skip")
    asked = threading.Thread(target=page.session.confirm, args=("Record sine-01 again",))
    asked.start()
    expect(window.get_by_role("button", name="Repeat")).to_be_focused()
    expect(window.locator("#confirm")).to_be_hidden()
    window.keyboard.press("Escape")
    asked.join()
    assert page.session.buttons.pressed == "stop"
    expect(window.locator("#status")).to_have_text("Stopping.")


def test_all_open_pages_show_the_same(page, show):
    """A page opened during a run shows the earlier points.

    An answer on one page counts for both.
    """
    first = show()
    record(page)
    second = show(size=PHONE)
    expect(second.locator("#plots .keys").first).to_contain_text("cart 1 3.99")
    threading.Thread(target=page.session.confirm, args=("let go",)).start()
    expect(first.locator("#ask")).to_be_visible()
    second.get_by_role("button", name="Done").click()
    expect(first.locator("#ask")).to_be_hidden()


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("size", [WIDE, PHONE], ids=["wide", "phone"])
def test_the_live_page_is_accessible(page, show, size):
    """The live page is accessible (axe) by day and night, and nothing is wider than the screen."""
    window = show(size=size)
    record(page)
    threading.Thread(target=page.session.confirm, args=("let go of all carts",)).start()
    page.session.remark("the bench has no watchdog")
    expect(window.locator("#told")).to_be_visible()
    assert violations(window) == []
    assert window.evaluate("document.documentElement.scrollWidth") <= size[0]
    page.session.answer(1)


@pytest.mark.slow
@pytest.mark.sample
def test_a_session_is_watched_and_confirmed_in_the_browser(tmp_path, browser):
    """With `acquire --web`, a button on the page starts a recording; no file has the secret."""
    work = write_work(tmp_path / "work", [sine("dwell", seconds=1, settle=0.3)])
    toml = work / "submission.toml"
    scaled = toml.read_text(encoding="utf-8").replace('"cm"', '"cm", per_count = 0.00227')
    toml.write_text(scaled, encoding="utf-8")
    command = [sys.executable, "-m", "pipeline", "acquire", str(work), "--web"]
    context = browser.new_context()
    context.set_default_timeout(1e3 * PATIENCE)
    with emulator("--stock", "--speed", "5") as bench:
        command += ["--port", bench.address, "--only", "dwell"]
        with started(command, stderr=subprocess.PIPE, encoding="utf-8") as host:
            url = address(host)
            window = context.new_page()
            window.goto(url)
            expect(window.get_by_role("alert")).to_have_text("All carts free")
            window.get_by_role("button", name="Done").click()
            expect(window.locator("#status")).to_have_text("The session is over.")
            expect(window.locator("#plan .done b")).to_have_text("dwell")
            host.wait(PATIENCE)
    assert host.returncode == 0
    secret = urlsplit(url).path.strip("/").encode()
    files = [path.read_bytes() for path in work.rglob("*") if path.is_file()]
    assert len(files) >= 4
    assert not any(secret in file for file in files)
    context.close()
