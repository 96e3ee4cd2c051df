"""The rubric editor: what `check-rubric` says, beside the lines; what is wrong is not saved."""

from pathlib import Path
from urllib.parse import urlencode

from starlette.responses import RedirectResponse, Response

from pipeline.desk.state import Ask
from pipeline.desk.typed import typed_path
from pipeline.errors import ConfigError
from pipeline.grading.rubric_file import InvalidRubric, parse_rubric, rubric_source
from pipeline.grading.rubric_text import rubric_text
from pipeline.output import write_file
from pipeline.resources import RUBRICS
from pipeline.submission.edit import text_digest

_NEW = "new"  # what a form has seen of a file that is not there


def show(ask: Ask) -> Response:
    """Show a rubric: a file of this computer, or a shipped one to begin with."""
    sent = ask.request.query_params
    typed, start = sent.get("file", ""), sent.get("start", "")
    path = _path(ask, typed or "rubric.toml")
    if path.exists():
        text = rubric_source(path)
        return _page(ask, path, text, seen=text_digest(text))
    shipped = sorted(path.stem for path in RUBRICS.glob("*.toml"))
    text = rubric_source(RUBRICS / f"{start}.toml") if start in shipped else ""
    return _page(ask, path, text, seen=_NEW)


def check(ask: Ask) -> Response:
    """Show what is wrong with what is typed; nothing is written."""
    return _page(ask, _path(ask, ask.text("file")), _typed(ask), seen=ask.text("seen"))


def save(ask: Ask) -> Response:
    """Write a rubric that is valid over the file that was shown, and over no other."""
    path, text, seen = _path(ask, ask.text("file")), _typed(ask), ask.text("seen")
    now = rubric_source(path) if path.exists() else None
    if seen != (_NEW if now is None else text_digest(now)):
        return _page(ask, path, text, seen=seen, now=now or "", status=409)
    if _problems(text):
        return _page(ask, path, text, seen=seen, status=422)
    write_file(path, text)
    query = urlencode({"file": path, "saved": 1})
    return RedirectResponse(f"/rubric/?{query}", status_code=303)


def _page(
    ask: Ask, path: Path, text: str, *, seen: str, now: str | None = None, status: int = 200
) -> Response:
    """Show the editor; where the file was changed meanwhile, with what it is `now`."""
    problems, lines = _problems(text) if text.strip() else [], text.split("\n")
    return ask.page(
        "rubric",
        status=status,
        title=path.name,
        file=path,
        text=text,
        seen=seen,
        now=now,
        problems=[(n, lines[n - 1] if 0 < n <= len(lines) else "", what) for n, what in problems],
        asks="" if problems or not text.strip() else rubric_text(parse_rubric(text, where="")),
        shipped=sorted(path.stem for path in RUBRICS.glob("*.toml")),
        saved="saved" in ask.request.query_params,
    )


def _problems(text: str) -> list[tuple[int, str]]:
    """Return what is wrong: the number of the line, 0 for none, and the sentence."""
    try:
        parse_rubric(text, where="rubric")
    except InvalidRubric as error:
        return list(error.problems)
    return []


def _typed(ask: Ask) -> str:
    """Return the text as a file has it: forms end lines in their own way."""
    text = ask.form.get("text")
    plain = text.replace("\r\n", "\n") if isinstance(text, str) else ""
    return plain.rstrip() + "\n"


def _path(ask: Ask, typed: str) -> Path:
    wanted = "name the file of the rubric, such as rubric.toml"
    path = typed_path(typed, wanted=wanted, inside=ask.user.workshop)
    if path.suffix != ".toml":
        raise ConfigError(f"{path}: a rubric is a .toml file")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}")
    return path
