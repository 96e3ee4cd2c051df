"""The student's room: files, form, report, questions, the zip. The folder on disk is the truth."""

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import tomlkit
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.jobs import Failed
from pipeline.desk.pages import served_file
from pipeline.desk.state import NOTHING_KNOWN, Ask
from pipeline.desk.student.files import put_aside, take_uploads
from pipeline.desk.student.form import (
    Field,
    apply,
    experiment_fields,
    field_text,
    groups,
    read_document,
    remove_experiment,
    typed,
    with_errors,
)
from pipeline.desk.student.handin import BESIDE, beside, hand_in, missing
from pipeline.errors import SubmissionError
from pipeline.lock import turn_in
from pipeline.names import by_note
from pipeline.output import write_file
from pipeline.report.numbers import count, listing
from pipeline.report.sections.answers import with_answer, written_answer
from pipeline.submission.edit import Outdated, edit_submission, submission_text, text_digest
from pipeline.submission.load import (
    MAX_NOTES_BYTES,
    NAME,
    outside,
    parse_submission,
    posix,
    stated_columns,
)
from pipeline.submission.models import MOST_EXPERIMENTS
from pipeline.submission.toml_file import read_text

_ASKED = "report/questions.json"
_MOST_ASKED = 1_000_000  # bytes
_NOTES = "notes.md"
_MANY = 3  # files of which the same is said: once, under the table
_GAP_BUDGET = 60.0  # s, as `cartlab gap` has by default


def show(ask: Ask) -> Response:
    """Show the room as the folder is now."""
    return _room(ask)


def upload(ask: Ask) -> Response:
    """Take files, and write down what they are."""
    folder, items = ask.folder(), ask.form.getlist("files")
    sent = [(i.filename, i.file) for i in items if isinstance(i, UploadFile) and i.filename]
    said = take_uploads(sent, folder, hand=ask.desk.hand)
    return ask.back(_here(ask), *said, *_filled(ask, folder))


def aside(ask: Ask) -> Response:
    """Move a recording out of `data/` that no table names."""
    folder, file = ask.folder(), ask.text("file")
    if file not in ask.desk.hand.do("files", folder=str(folder)):
        raise HTTPException(404, "there is no such recording")
    with turn_in(folder):
        document = read_document(submission_text(folder) if (folder / NAME).exists() else "")
        if any(posix(str(table.get("file", ""))) == file for table in _tables(document)):
            raise SubmissionError(f"{file}: {NAME} names it; take it out there first")
        said = put_aside(file, folder)
    return ask.back(_here(ask), said)


def fill(ask: Ask) -> Response:
    """Write the tables of files that have none."""
    return ask.back(_here(ask), *_filled(ask, ask.folder()))


def save(ask: Ask) -> Response:
    """Write the form into the file."""
    fields = [field for group in groups(_shown(ask)) for field in group.fields]
    return _save(ask, fields)


def save_experiment(ask: Ask) -> Response:
    """Write one row of the table of files into its table, or take the table away."""
    index = ask.request.path_params["index"]
    if ask.text("remove"):
        return _edited(ask, lambda document: remove_experiment(document, index), changed=[])
    return _save(ask, experiment_fields(_shown(ask), index))


def start_report(ask: Ask) -> Response:
    """Have the report made."""
    folder = ask.folder()
    ask.desk.jobs.start("report", title="The report", place=folder, folder=str(folder))
    return ask.back(_here(ask) + "#report")


def start_gap(ask: Ask) -> Response:
    """Have the data asked what the linear model leaves out."""
    folder = ask.folder()
    ask.desk.jobs.start(
        "gap", title="The gap", place=folder, folder=str(folder), budget=_GAP_BUDGET
    )
    return ask.back(_here(ask) + "#report")


def stop(ask: Ask) -> Response:
    """Stop what is under way in the folder."""
    if job := ask.desk.jobs.of(ask.folder()):
        job.stop.set()
    return ask.back(_here(ask) + "#report")


def report(ask: Ask) -> Response:
    """Show the report with its questions, and claims beside what the data say."""
    return _asked(ask)


def answer(ask: Ask) -> Response:
    """Write the answer to a question into `notes.md`; what cannot be is shown as typed."""
    folder, id_, words = ask.folder(), ask.text("id"), ask.text("answer")
    try:
        with turn_in(folder):
            notes = _notes(folder)
            if ask.text("seen") != text_digest(notes):
                yours = [Field(path=id_, label=f"Answer to {id_}", value=words)]
                return _outdated(ask, _NOTES, notes, yours)
            if id_ not in [one["id"] for one in _told(folder)["questions"]]:
                raise SubmissionError(f"the report asks nothing called {id_!r}")
            new = with_answer(notes, id_, words)
            if len(new.encode()) > MAX_NOTES_BYTES:
                raise SubmissionError(f"{_NOTES} would have more than {MAX_NOTES_BYTES:,} bytes")
            write_file(folder / _NOTES, new)
    except SubmissionError as error:
        return _asked(ask, status=422, refused={id_: (words, str(error))})
    return ask.back(f"{_here(ask)}report#question-{id_}", "Written into notes.md.")


def report_file(ask: Ask) -> Response:
    """Return a file of the report, which runs no script but the report's own."""
    return served_file(ask.folder(), f"report/{ask.request.path_params['name']}")


def gap_file(ask: Ask) -> Response:
    """Return a file of the gap's page, likewise."""
    return served_file(ask.folder(), f"gap/{ask.request.path_params['name']}")


def packed(ask: Ask) -> Response:
    """Return the zip."""
    name = f"{ask.folder().name}.zip"
    plain = re.sub(r"[^A-Za-z0-9_.-]", "-", name)  # other letters by RFC 5987, beside this
    disposition = f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"
    headers = {"Content-Disposition": disposition}
    return Response(hand_in(ask.folder()), media_type="application/zip", headers=headers)


# ------------------------------------------------------------------------------- parts


def _here(ask: Ask) -> str:
    return f"/student/{ask.request.path_params['n']}/"


def _shown(ask: Ask) -> dict[str, Any]:
    """Return the file that a form was filled in for: what differs from that was typed."""
    text = ask.desk.shown(ask.text("seen"), to=ask.user.name)
    return read_document(submission_text(ask.folder()) if text is None else text)


def _filled(ask: Ask, folder: Path) -> list[str]:
    """Have the tables of new files written; return what is to be said."""
    try:
        rows = ask.desk.hand.do("fill", folder=str(folder))
    except Failed as error:
        return [str(error)]
    new = [row["file"] for row in rows if row["state"] in ("new", "completed")]
    return [f"{count(len(new), 'file')} written into {NAME}."] if new else []


def _asked(ask: Ask, *, status: int = 200, refused: Mapping[str, tuple[str, str]] = {}) -> Response:
    """Show the report.

    Parameters
    ----------
    refused : by question, an answer as it was typed, and why it was not written.
    """
    folder, told = ask.folder(), _told(ask.folder())
    problems, notes = [why for _, why in refused.values()], ""
    try:
        notes = _notes(folder)
    except SubmissionError as error:
        problems = [str(error)]
    questions, known = [], [one["id"] for one in told["questions"]]
    others = [{"id": id_, "text": f"Answer to {id_}"} for id_ in refused if id_ not in known]
    for one in [*told["questions"], *others]:
        words, why = refused.get(one["id"]) or (written_answer(notes, one["id"]), "")
        questions.append({**one, "answer": words, "wrong": why})
    return ask.page(
        "report",
        status=status,
        title=f"Report of {folder.name}",
        told=told,
        questions=questions,
        problems=problems,
        seen=text_digest(notes),
        there=outside(folder, "report/report.html") is None,
        said=ask.told(),
        here=_here(ask),
    )


def _room(
    ask: Ask,
    *,
    status: int = 200,
    changed: Sequence[Field] = (),
    error: SubmissionError | None = None,
) -> Response:
    """Show the room; with what was typed in place of what stands in the file, where it is wrong."""
    folder, text = ask.folder(), ""
    try:
        text = submission_text(folder) if (folder / NAME).exists() else ""
    except SubmissionError as unreadable:
        error = unreadable
    document = read_document(text)
    ask.desk.keep_shown(text, digest=text_digest(text), to=ask.user.name)
    if error is None and text:
        error = _wrong(text, folder)
    rows = _rows(ask, folder, document)
    form = groups(document)
    every = [f for group in form for f in group.fields] + [f for r in rows for f in r["fields"]]
    shown, left = with_errors(every, changed, error)
    by_path = {field.path: field for field in shown}
    job, told = ask.desk.jobs.of(folder), _told(folder)
    return ask.page(
        "student",
        status=status,
        title=folder.name,
        folder=folder,
        rows=[{**row, "fields": [by_path[f.path] for f in row["fields"]]} for row in rows],
        often=_often(rows),
        groups=[group.filled(by_path) for group in form] if document else [],
        seen=text_digest(text),
        wrong=left,
        keeps=_keeps(folder) if text and error is None else [],
        sound=bool(text) and error is None,
        holds=listing([NAME, "the files that it names", *(BESIDE[one] for one in beside(folder))]),
        job=job,
        report=_report_state(folder),
        told=told,
        unanswered=_unanswered(folder, told),
        gap=outside(folder, "gap/gap.html") is None,
        said=ask.told(),
        here=_here(ask),
    )


def _often(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return what there is to say of many files, each with its sentence that names them."""
    told = [(row["file"], said) for row in rows for said in row["look"]["remarks"]]
    times = Counter(said for _, said in told)
    many = [said for said, number in times.items() if number >= _MANY]
    return {
        said: by_note((file.removeprefix("data/"), one) for file, one in told if one == said)[0]
        for said in many
    }


def _unanswered(folder: Path, told: Mapping[str, Any]) -> int:
    try:
        notes = _notes(folder)
    except SubmissionError:  # the report's page says what is wrong with them
        notes = ""
    return sum(not written_answer(notes, one["id"]).strip() for one in told["questions"])


def _wrong(text: str, folder: Path) -> SubmissionError | None:
    """Return what is wrong with the file as it stands."""
    try:
        parse_submission(text, folder=folder)
    except SubmissionError as error:
        return error
    return None


def _keeps(folder: Path) -> list[str]:
    try:
        return missing(folder)
    except SubmissionError as error:
        return [str(error)]


def _rows(ask: Ask, folder: Path, document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for every data file, and for every table whose file is not there."""
    listed = _tables(document)[:MOST_EXPERIMENTS]  # further ones are what is wrong with the file
    places: dict[str, list[int]] = {}
    for index, table in enumerate(listed):
        places.setdefault(posix(str(table.get("file", ""))), []).append(index)
    rows = []
    known = {**document, "experiments": listed}
    looks = ask.desk.looks(folder, lambda file: stated_columns(known, file))
    for file, look in looks.items():
        for index in places.pop(file, [None]):
            rows.append(_row(document, file, look, index, listed))
    gone = {**NOTHING_KNOWN, "remarks": ["there is no such file"]}
    for file, indices in places.items():
        rows += [_row(document, file, gone, index, listed) for index in indices]
    return rows


def _tables(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    tables = document.get("experiments")
    return [t for t in tables if isinstance(t, dict)] if isinstance(tables, list) else []


def _row(
    document: Mapping[str, Any],
    file: str,
    look: Mapping[str, Any],
    index: int | None,
    listed: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    fields = () if index is None else experiment_fields(document, index)
    if any(field.path.endswith("controller.type") and not field.value for field in fields):
        look = {**look, "unsure": [*look["unsure"], "say what controller ran, below its kind"]}
    return {
        "file": file,
        "look": look,
        "index": index,
        "id": "" if index is None else str(listed[index].get("id", "")),
        "fields": fields,
    }


def _save(ask: Ask, fields: Sequence[Field]) -> Response:
    changed = typed(fields, ask.form, ask.form.getlist)
    return _edited(ask, lambda document: apply(document, changed), changed=changed)


def _edited(
    ask: Ask, change: Callable[[tomlkit.TOMLDocument], None], *, changed: Sequence[Field]
) -> Response:
    """Change the file; what would not be valid is shown as typed, what is outdated is refused."""
    folder = ask.folder()
    try:
        edit_submission(folder, change, seen=ask.text("seen") or "nothing")
    except Outdated as error:
        return _outdated(ask, NAME, error.text, changed)
    except SubmissionError as error:
        return _room(ask, status=422, changed=changed, error=error)
    return ask.back(_here(ask), "Saved.")


def _outdated(ask: Ask, name: str, text: str, changed: Sequence[Field]) -> Response:
    """Show both versions: the file as it is now, and what was typed."""
    now = read_document(text) if name == NAME else {}
    # Of a page older than all that is known, nobody can say what was typed in it.
    known = name != NAME or ask.desk.shown(ask.text("seen"), to=ask.user.name) is not None
    return ask.page(
        "outdated",
        status=409,
        title=f"{name} was changed meanwhile",
        name=name,
        text=text,
        changed=[(field, field_text(now, field)) for field in changed],
        had="You typed" if known else "Your page had",
        back=_here(ask) + ("report" if name == _NOTES else ""),
    )


def _notes(folder: Path) -> str:
    if not (folder / _NOTES).exists():
        return ""
    if problem := outside(folder, _NOTES):
        raise SubmissionError(problem)
    where = f"{folder.name}/{_NOTES}"
    return read_text(folder / _NOTES, where=where, limit=MAX_NOTES_BYTES, error=SubmissionError)


def _told(folder: Path) -> dict[str, Any]:
    """Return what the last report said and asked, as far as its file can be read."""
    told: Any = {}
    if outside(folder, _ASKED) is None and (folder / _ASKED).stat().st_size < _MOST_ASKED:
        with suppress(ValueError, RecursionError):
            told = json.loads((folder / _ASKED).read_bytes())
    try:
        questions = [{"id": str(one["id"]), "text": str(one["text"])} for one in told["questions"]]
        failed = [str(one) for one in told["failed"]]
        return {"questions": questions, "failed": failed, "changes": str(told["changes"])}
    except (KeyError, TypeError):
        return {"questions": [], "failed": [], "changes": ""}


def _report_state(folder: Path) -> str:
    """Return "none", "current", or "older" than what it is made of."""
    if outside(folder, "report/report.html") is not None:
        return "none"
    made = (folder / "report" / "report.html").stat().st_mtime_ns
    sources = [folder / NAME, folder / _NOTES, *(folder / "data").rglob("*")]
    newer = any(path.stat().st_mtime_ns > made for path in sources if path.is_file())
    return "older" if newer else "current"
