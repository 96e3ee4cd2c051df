"""Without scripts, the bench's pages make a plan, record a session and stop it."""

import http.client
import json
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlencode

import pytest

from pipeline.bench.raw import read_raw
from pipeline.desk.app import DeskServer
from pipeline.desk.benches import BenchSession
from pipeline.experiments.plan import load_plan
from pipeline.report.exploration import NAME as DIARY
from pipeline.submission import load_submission, new_submission
from tests.helpers.acquisitions import sine, write_work
from tests.helpers.desks import Visitor, a_recorded_cart, at_desk
from tests.helpers.waiting import PATIENCE, address, kill, until

pytestmark = pytest.mark.usefixtures("all_work_here")
NOBODY = "socket://127.0.0.1:1"
SWEEP = sine("sweep", seconds=300).model_copy(update={"kind": "sweep", "wave": "square"})


def begun(visitor: Visitor, work: Path, name: str, room: str = "acquire", **fields: str) -> None:
    """Begin a session, and wait until a second of a run is recorded."""
    answer = visitor.post(f"/bench/0/{room}", **fields)
    assert answer.status == 303, answer.text
    raw = work / "raw" / f"{name}-1.raw"
    until(lambda: raw.exists() and raw.stat().st_size > 20_000, "a run")


def test_a_plan_is_proposed_and_a_session_recorded_and_stopped(tmp_path, real):
    """A ticked recording is made and can be watched, and Stop ends the session without scripts."""
    work = write_work(tmp_path / "team", [sine("short", seconds=1), sine("long", seconds=300)])
    with at_desk(work) as visitor:
        page = visitor.get("/bench/0/")
        assert 'value="long" aria-label="long"' in page.text
        begun(visitor, work, "long", port=real.address, only="long")
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
        # When the first state is sent, the stop may or may not have been noticed.
        assert json.loads(states[0])["waits"] in ("Recording long.", "Stopping.")
        assert json.loads(states[-1])["phase"] == "over"
        # A late viewer gets the earlier points.
        first, *_ = map(json.loads, re.findall(rb"event: points\ndata: (.*)\n", heard[0]))
        assert (first["run"], first["start"]) == (1, 0)
        assert first["points"][0][0] < 0.1 < 0.5 < first["points"][-1][0]
        # The last event says that the plan is shown again, so that open pages reload.
        assert heard[0].endswith(b"event: ended\ndata:\n\n")
        assert "Stopped. Start again" in visitor.get("/bench/0/").text
        assert visitor.get("/bench/0/events").body == b"event: ended\ndata:\n\n"
        assert visitor.post("/bench/0/press", wish="stop", number="0").status == 404
    while (ended := real.event("run"))["ended"] == "complete":
        pass
    assert ended["ended"] == "stopped"
    assert (work / "data" / "long.partial.txt").exists()
    assert load_submission(work).experiments == ()


@pytest.mark.slow
@pytest.mark.sample
def test_many_viewers_block_nobody(tmp_path, real):
    """If sixty viewers open a session, eight are connected and the others are refused at once.

    Meanwhile the desk still serves its other pages.
    """
    work = write_work(tmp_path / "team", [sine("long", seconds=300)])
    with DeskServer(folder=work) as server, ExitStack() as streams:
        visitor = Visitor.of(server.url)
        begun(visitor, work, "long", port=real.address)
        until(lambda: 'id="positions"' in visitor.get("/bench/0/").text)
        answers = []
        for _ in range(60):
            connection = http.client.HTTPConnection("127.0.0.1", visitor.port, timeout=PATIENCE)
            streams.callback(connection.close)
            connection.request("GET", "/bench/0/events", headers=visitor.headers)
            answers.append(connection.getresponse())
        assert visitor.get("/student/0/").status == 200
        assert Counter(answer.status for answer in answers) == {200: 8, 503: 52}
        watched = [answer for answer in answers if answer.status == 200]
        assert all(answer.readline() == b"event: state\n" for answer in watched)
        assert visitor.post("/bench/0/press", wish="stop", number="0").status == 204
        assert all(b"event: ended\n" in answer.read() for answer in watched)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize(
    ("name", "room", "fields"),
    [
        ("long", "acquire", {"only": "long"}),
        pytest.param(
            "sweep",
            "explore",
            {"what": "all", "error": "1", "minutes": "20"},
            marks=[pytest.mark.slow, pytest.mark.sample],
        ),
    ],
)
def test_the_bench_is_stopped_when_the_desk_is_gone(tmp_path, real, name, room, fields):
    """If the desk is killed during a run, the acquisition stops the bench and saves the run."""
    work = write_work(tmp_path / "team", [sine("long", seconds=300), SWEEP])
    command = [sys.executable, "-m", "pipeline", "desk", str(work), "--no-browser"]
    desk = subprocess.Popen(command, stderr=subprocess.PIPE, encoding="utf-8")
    try:
        url = address(desk)
        (work / DIARY).write_text("of an older exploration", encoding="utf-8")
        visitor = Visitor.of(url)
        begun(visitor, work, name, room, port=real.address, **fields)
        # The diary of an older exploration stays hidden until this one has written its own.
        shown = re.findall(r'aria-labelledby="diary-title"(.*)>', visitor.get("/bench/0/").text)
        assert all(how.startswith(" hidden>") for how in shown)
        assert len(shown) == (room == "explore")
        desk.send_signal(signal.SIGKILL)
        desk.wait(PATIENCE)
        while (ended := real.event("run"))["ended"] == "complete":
            pass
        assert ended["ended"] == "stopped"
        until((work / "data" / f"{name}.partial.txt").exists)
    finally:
        kill(desk)
        assert desk.stderr is not None
        desk.stderr.close()
    assert len(read_raw(work / "raw" / f"{name}-1.raw").content) > 10_000  # half a second of lines


@pytest.mark.slow
@pytest.mark.sample
def test_a_plan_is_made_and_errors_are_named(tmp_path):
    """The desk makes the same plan as `cartlab plan`, and an error names a missing bench."""
    work = tmp_path / "team"
    work.mkdir()
    text = 'version = 1\n[system]\ncarts = 1\nposition = { unit = "cm" }\n'
    (work / "submission.toml").write_text(text, encoding="utf-8")
    with at_desk(work) as visitor:
        assert visitor.post("/bench/0/plan").status == 303
        until((work / "plan.toml").exists)
        assert visitor.post("/bench/0/acquire", port=" ").status == 422
        visitor.post("/bench/0/explore", port=NOBODY, what="all", error="1", minutes="1")
        shown = [visitor.get("/bench/0/").text]
        until(lambda: shown.append(visitor.get("/bench/0/").text) or "alert" in shown[-1])
        assert NOBODY in shown[0]
        visitor.post("/bench/0/acquire", port=NOBODY)
        assert visitor.post("/bench/0/press", wish="skip", number="0").status == 503
        assert visitor.post("/bench/0/press", wish="stop", number="0").status == 204
        until(lambda: "Waiting for the bench" not in visitor.get("/bench/0/").text)
        assert not any('id="positions"' in page for page in shown)  # the session never began
        assert "no bench listens" in shown[-1]
    assert load_plan(load_submission(work)).recordings


@pytest.mark.slow
@pytest.mark.sample
def test_exploring_has_its_own_form(tmp_path):
    """Exploring has its own form with its own port, and Enter in a field starts exploring.

    Numbers may have a decimal comma, and an error names its field.
    """
    work = a_recorded_cart(tmp_path / "team")
    with at_desk(work) as visitor:
        forms = re.findall(
            r"<form[^>]*?action=[^>]*?>.*?</form>", visitor.get("/bench/0/").text, re.DOTALL
        )
        fields = {
            re.findall(r'action="/bench/0/(\w+)"', form)[0]: set(re.findall(r'name="(\w+)"', form))
            for form in forms
        }
        ports = {"port", "other"} & fields["acquire"]  # `other` takes a port that is not listed
        assert fields["explore"] == {*ports, "what", "error", "minutes"}
        assert fields["acquire"] == ports
        sound = {"port": "socket://127.0.0.1:1", "what": "all", "error": "1,5", "minutes": "0,5"}
        for name, typed, said in (
            ("error", "", "Accuracy to reach, ± %: expected a number above 0 and below 100"),
            ("error", "100", "Accuracy to reach, ± %"),
            ("minutes", "-1", "minutes: expected a number above 0"),
            ("minutes", "soon", "minutes"),
        ):
            answer = visitor.post("/bench/0/explore", **{**sound, name: typed})
            assert answer.status == 422
            assert said in answer.text
        assert visitor.post("/bench/0/explore", **sound).status == 303
        until(lambda: "no bench listens" in visitor.get("/bench/0/").text)


def test_an_experiment_is_proposed_weighed_and_added(tmp_path):
    """For a proposed experiment the page shows the standard errors before and after it.

    The experiment can be added to the plan. The program's own choice is shown too, and bad input
    gets a message.
    """
    work = a_recorded_cart(tmp_path / "team")
    mine = {"kind": "sweep", "amplitude": "0,01", "frequency": "0.5", "frequency_end": "5",
            "seconds": "20", "goal": "zeta"}  # fmt: skip
    with at_desk(work) as visitor:
        answer = visitor.get(f"/bench/0/weigh?{urlencode(mine)}")
        assert answer.status == 200, answer.text
        shares = [float(share) for share in re.findall(r"<td>± ([\d.e-]+) %</td>", answer.text)]
        now, after, best = shares
        assert now > after > best
        said = f"The damping ratio ζ: ± {now:.2g} % now, ± {after:.2g} % after your experiment"
        assert said in answer.text
        assert answer.text.index(said) < answer.text.index("What would cartlab have chosen?")
        assert 'value="0,01"' in answer.text  # as typed
        decay = visitor.get("/bench/0/weigh?kind=decay&seconds=20&cart=1")
        assert "but this is a decay" in decay.text
        for name, typed in (("amplitude", "20"), ("amplitude", "nan"), ("kind", "closed_loop"),
                            ("cart", "9"), ("seconds", "1e999"), ("goal", "zeta_9")):  # fmt: skip
            wrong = {**mine, name: typed}
            assert visitor.get(f"/bench/0/weigh?{urlencode(wrong)}").status == 422
        blank = visitor.get(f"/bench/0/weigh?{urlencode(mine | {'frequency': ''})}")
        assert blank.status == 422
        assert 'name="frequency_end"' not in decay.text  # no fields of other kinds of experiment
        assert 'name="amplitude"' not in decay.text
        assert "found" not in re.findall('class="wrong" role="alert">(.*?)<', blank.text)[0]
        assert not (work / "plan.toml").exists()
        assert visitor.post("/bench/0/add", **{**mine, "amplitude": "20"}).status == 422
        assert visitor.post("/bench/0/add", **mine).status == 303
        assert "sweep-1 is in the plan" in visitor.get("/bench/0/").text
        assert visitor.post("/bench/0/explore", port="x", what="all", minutes="1").status == 422
    (added,) = [one for one in load_plan(load_submission(work)).recordings if one.id == "sweep-1"]
    assert (added.amplitude, added.frequency_end) == (0.01, 5.0)


def test_new_recordings_in_the_plan_are_marked(tmp_path):
    """The plan marks which runs are recorded, which is next, and which was added last."""
    work = write_work(tmp_path / "team", [sine("first", seconds=1), sine("second", seconds=1)])
    with at_desk(work) as visitor:
        rows = re.findall(r"<tr.*?</tr>", visitor.get("/bench/0/").text, re.DOTALL)
        marked = [re.findall(r'class="chip \w+">(\w+)<', row) for row in rows if "checkbox" in row]
        assert marked == [["next"], []]
        mine = {"kind": "step", "amplitude": "0.02", "seconds": "20"}
        assert visitor.post("/bench/0/add", **mine).status == 303
        rows = re.findall(r"<tr.*?</tr>", visitor.get("/bench/0/").text, re.DOTALL)
        marked = [re.findall(r'class="chip \w+">(\w+)<', row) for row in rows if "checkbox" in row]
        assert marked == [["next"], [], ["new"]]


@pytest.mark.parametrize(
    ("wish", "number", "counts"),
    [
        ("stop", 0, True),  # at any time
        ("skip", 7, True),
        ("skip", 6, False),  # of an earlier recording
        ("keep", 7, False),  # not offered now
        ("done", 3, True),
        ("done", 2, False),
    ],
)
def test_only_a_button_that_is_offered_counts_but_stop_always(wish, number, counts):
    """`apply` sends a button to the bench if it is offered in this turn, and a stop always."""
    sent: list[bytes] = []
    state = {"instruction": {"number": 3}, "offered": ["skip"], "turn": 7}
    session: Any = SimpleNamespace(_state=state, _process=SimpleNamespace(send=sent.append))
    assert BenchSession.apply(session, wish, number) == counts
    assert len(sent) == counts


def test_the_bench_of_the_folder_s_name_is_offered_first(tmp_path, monkeypatch):
    """A team whose folder is called as its virtual bench does not record a neighbour's."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    (tmp_path / "run").mkdir()
    new_submission(work := tmp_path / "team-2", carts=1)
    code = """
import sys
from pipeline.simulated.links import RunningBench, announced
with announced(RunningBench(name=sys.argv[1], address=sys.argv[2])):
    print("ready", flush=True)
    sys.stdin.read()
"""
    with ExitStack() as running:
        for number, name in enumerate(("team-1", "team-2", "team-3"), start=1):
            command = [sys.executable, "-c", code, name, f"socket://127.0.0.1:{number}"]
            bench = running.enter_context(
                subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            )
            running.callback(bench.communicate)
            assert bench.stdout
            assert bench.stdout.readline()
        with at_desk(work) as visitor:
            page = visitor.get("/bench/0/").text
        listed = re.findall(r'<option value="socket://127.0.0.1:(\d)"', page)
    assert listed[:3] == ["2", "1", "3"]
