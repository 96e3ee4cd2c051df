"""The desk limits what one person can ask at once, and its own process reads no student's file."""

import asyncio
import tomllib
from typing import Any

import pytest
import tomlkit
from starlette.exceptions import HTTPException

from pipeline.desk.app import AT_ONCE, limit_each_person
from pipeline.desk.users import User
from tests.helpers.desks import a_submission, at_desk


class Requests:
    """Requests to an application that answers when it is told to."""

    def __init__(self, **options) -> None:
        self.free, self.running, self.sent = asyncio.Event(), list[str](), list[dict]()
        self._app = limit_each_person(self._answer, **options)

    async def _answer(self, scope, receive, send) -> None:
        self.running.append(scope["user"].name)
        await self.free.wait()
        while (await receive())["more_body"]:
            pass
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def ask(self, name: str, path: str = "/", *, body=({"more_body": False},)) -> int:
        """Send a request; return the status of its answer."""
        parts, status = list(body), [0]

        async def receive() -> Any:
            return parts.pop(0) if parts else await asyncio.Event().wait()

        async def send(message) -> None:
            status[0] = message.get("status", status[0])

        user = User(name=name, role="student")
        scope = {"type": "http", "method": "POST", "path": path, "user": user, "headers": []}
        await self._app(scope, receive, send)
        return status[0]


def test_one_person_has_four_answers_at_a_time():
    """Further requests of one person wait or are refused; other people are answered."""

    async def run() -> None:
        desk = Requests()
        asked = [asyncio.create_task(desk.ask("a")) for _ in range(60)]
        await asyncio.sleep(0.01)
        assert desk.running == ["a"] * AT_ONCE
        refused = [one for one in asked if one.done()]
        assert {await one for one in refused} == {429}
        others = [asyncio.create_task(desk.ask(*one)) for one in (("b",), ("a", "/grades/0/stop"))]
        await asyncio.sleep(0.01)
        assert sorted(desk.running) == ["a"] * (AT_ONCE + 1) + ["b"]
        desk.free.set()
        answers = await asyncio.gather(*asked, *others)
        assert answers.count(200) == len(asked) - len(refused) + 2
        assert await desk.ask("a") == 200  # a person who was refused is answered later

    asyncio.run(run())


def test_a_body_that_stops_arriving_is_refused():
    """A request ends if nothing of its body arrives for a while, and gives its turn back."""

    async def run() -> None:
        desk = Requests(stalled=0.02)
        desk.free.set()
        for _ in range(AT_ONCE + 1):
            with pytest.raises(HTTPException, match="upload") as error:
                await asyncio.wait_for(desk.ask("a", body=[{"more_body": True}]), 20)
            assert error.value.status_code == 408

    asyncio.run(run())


@pytest.mark.slow
@pytest.mark.sample
def test_the_desk_itself_reads_nothing_that_a_student_wrote(tmp_path, monkeypatch):
    """No page of a student makes the desk's own process parse a file of the submission."""
    folder = a_submission(tmp_path / "team")
    toml = (folder / "submission.toml").read_bytes()
    with at_desk(folder) as visitor:
        page = visitor.get("/student/0/")

        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("parsed in the desk's own process")

        for module, name in ((tomllib, "loads"), (tomlkit, "parse"), (tomllib, "load")):
            monkeypatch.setattr(module, name, refuse)
        for part in ("", "hand-in", "questions", "report", "check", "compare", "hand-in.zip"):
            assert visitor.get(f"/student/0/{part}").status == 200, part
        assert visitor.get("/").status == 200
        saved = visitor.post("/student/0/save", title="Another title", seen=page.value("seen"))
        assert saved.status == 303
        sent = [("submission.toml", toml), ("notes.md", b"# x"), ("new.csv", b"time,x1\n0,1\n")]
        assert visitor.upload("/student/0/files", sent).status == 303
        monkeypatch.undo()
    assert (folder / "data" / "new.csv").exists()
    assert "Another title" in (folder / "submission.toml").read_text(encoding="utf-8")
