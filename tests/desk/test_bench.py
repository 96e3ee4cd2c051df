"""The bench's room, over plain forms: a plan, a session, its buttons, its end."""

import json
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pipeline.bench.host.raw import read_raw
from pipeline.bench.planning.plan_file import load_plan
from pipeline.desk.app import DeskServer
from pipeline.submission import load_submission
from tests.helpers.acquisitions import sine, write_work
from tests.helpers.desks import Visitor
from tests.helpers.waiting import PATIENCE, kill, until


def begun(visitor: Visitor, work: Path, port: str, *only: str) -> None:
    """Have a session begin, and wait until it has written a second of a run."""
    body = "&".join([f"port={port}", *(f"only={name}" for name in only)])
    answer = visitor.send(
        "/bench/0/acquire", body.encode(), kind="application/x-www-form-urlencoded"
    )
    assert answer.status == 303, answer.text
    raw = work / "raw" / f"{only[0]}-1.raw"
    until(lambda: raw.exists() and raw.stat().st_size > 20_000, "a run")


def test_a_plan_is_proposed_and_a_session_recorded_and_stopped(tmp_path, real):
    """Ticked recordings are made; the news come through; a Stop without scripts ends it."""
    work = write_work(tmp_path / "team", [sine("short", seconds=1), sine("long", seconds=300)])
    with DeskServer(folder=work) as server:
        visitor = Visitor.of(server.url)
        page = visitor.get("/bench/0/")
        assert 'value="long" aria-label="long"' in page.text
        begun(visitor, work, real.address, "long")
        watched = visitor.get("/bench/0/")
        assert 'id="positions"' in watched.text
        heard: list[bytes] = []
        listener = threading.Thread(
            target=lambda: heard.append(visitor.get("/bench/0/events").body)
        )
        listener.start()
        assert visitor.post("/bench/0/press", wish="repeat", number="99").status == 409
        assert visitor.post("/bench/0/press", wish="stop", number="0", plain="1").status == 303
        listener.join()
        states = re.findall(rb"event: state\ndata: (.*)\n", heard[0])
        # How far the stop is when the first news are sent is not ours to say.
        assert json.loads(states[0])["waits"] in ("Recording long.", "Stopping.")
        assert json.loads(states[-1])["waits"] == "The session is over."
        # Told when the room shows the plan again: a page drawn just before hears it and reloads.
        assert heard[0].endswith(b"event: ended\ndata:\n\n")
        assert "Stopped. Begin again" in visitor.get("/bench/0/").text
        assert visitor.get("/bench/0/events").body == b"event: ended\ndata:\n\n"
        assert visitor.post("/bench/0/press", wish="stop", number="0").status == 404
    while (ended := real.event("run"))["ended"] == "complete":
        pass
    assert ended["ended"] == "stopped"
    assert (work / "data" / "long.partial.txt").exists()
    assert load_submission(work).experiments == ()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends no program so")
def test_the_bench_is_stopped_when_the_desk_is_gone(tmp_path, real):
    """Kill -9 of the desk in mid-run: its acquisition tells the bench to stop and saves."""
    work = write_work(tmp_path / "team", [sine("long", seconds=300)])
    command = [sys.executable, "-m", "pipeline", "desk", str(work), "--no-browser"]
    desk = subprocess.Popen(command, stderr=subprocess.PIPE, encoding="utf-8")
    try:
        assert desk.stderr is not None
        url = re.search(r"http://\S+", desk.stderr.readline())
        assert url is not None
        begun(Visitor.of(url[0]), work, real.address, "long")
        desk.send_signal(signal.SIGKILL)
        desk.wait(PATIENCE)
        while (ended := real.event("run"))["ended"] == "complete":
            pass
        assert ended["ended"] == "stopped"
        until((work / "data" / "long.partial.txt").exists)
    finally:
        kill(desk)
        assert desk.stderr is not None
        desk.stderr.close()
    assert len(read_raw(work / "raw" / "long-1.raw").content) > 10_000  # half of what was there


def test_a_plan_is_made_and_what_is_wrong_is_said(tmp_path):
    """The plan is what `cartlab plan` writes; a bench that is not there is named."""
    work = tmp_path / "team"
    work.mkdir()
    text = 'version = 1\n[system]\ncarts = 1\nposition = { unit = "cm" }\n'
    (work / "submission.toml").write_text(text, encoding="utf-8")
    with DeskServer(folder=work) as server:
        visitor = Visitor.of(server.url)
        assert visitor.post("/bench/0/plan").status == 303
        until((work / "plan.toml").exists)
        assert visitor.post("/bench/0/acquire", port=" ").status == 422
        visitor.post("/bench/0/acquire", port="socket://127.0.0.1:1")
        until(lambda: "nobody listens there" in visitor.get("/bench/0/").text)
    assert load_plan(load_submission(work)).recordings
