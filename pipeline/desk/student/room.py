"""The student's room: files, form, the zip. The folder on disk is the truth."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import tomlkit
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk import last_report
from pipeline.desk.jobs import Failed
from pipeline.desk.state import NOTHING_KNOWN, Ask
from pipeline.desk.student.files import put_aside, take_uploads
from pipeline.desk.student.form import (
    Field,
    apply,
    asked_for_unit,
    experiment_fields,
    field_text,
    groups,
    read_document,
    remove_experiment,
    typed,
    with_errors,
)
from pipeline.desk.student.handin import hand_in, held, missing
from pipeline.errors import SubmissionError
from pipeline.ingest.inspect import NO_CLOCK
from pipeline.lock import turn_in
from pipeline.names import by_note
from pipeline.report.numbers import count
from pipeline.submission.edit import Outdated, edit_submission, submission_text, text_digest
from pipeline.submission.load import (
    NAME,
    outside,
    parse_submission,
    posix,
    stated_columns,
)
from pipeline.submission.models import MOST_EXPERIMENTS

_MANY = 3  # files of which the same is said: once, under the table


def show(ask: Ask) -> Response:
    """Show the room as the folder is now."""
    return _room(ask)


def upload(ask: Ask) -> Response:
    """Take files, and write down what they are."""
    folder, items = ask.folder(), ask.form.getlist("files")
    sent = [(i.filename, i.file) for i in items if isinstance(i, UploadFile) and i.filename]
    said = take_uploads(sent, folder, hand=ask.desk.hand)
    return ask.back(ask.here, *said, *_filled(ask, folder))


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
    return ask.back(ask.here, said)


def fill(ask: Ask) -> Response:
    """Write the tables of files that have none."""
    return ask.back(ask.here, *_filled(ask, ask.folder()))


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


def start_hand_in(ask: Ask) -> Response:
    """Have the report made anew where anything was changed since; show what is handed in."""
    folder = ask.folder()
    if last_report.state(folder) != "current":
        ask.desk.jobs.start("report", title="The report", place=folder, folder=str(folder))
    return ask.back(f"{ask.here}hand-in")


def show_hand_in(ask: Ask) -> Response:
    """Show what the zip holds, what is not answered, and what was assumed."""
    folder = ask.folder()
    keeps = _keeps(folder)
    names = [] if keeps else held(folder)
    return ask.page(
        "handin",
        title=f"Hand in: {folder.name}",
        keeps=keeps,
        files=[(name, (folder / name).stat().st_size) for name in names],
        job=ask.desk.jobs.of(folder),
        report=last_report.state(folder),
        unanswered=last_report.unanswered(folder),
        assumed=last_report.told(folder)["assumed"],
        said=ask.told(),
    )


def packed(ask: Ask) -> Response:
    """Return the zip."""
    name = f"{ask.folder().name}.zip"
    plain = re.sub(r"[^A-Za-z0-9_.-]", "-", name)  # other letters by RFC 5987, beside this
    disposition = f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"
    headers = {"Content-Disposition": disposition}
    return Response(hand_in(ask.folder()), media_type="application/zip", headers=headers)


# ------------------------------------------------------------------------------- parts


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
    said = [f"{count(len(new), 'file')} written into {NAME}."] if new else []
    without = [row for row in rows if row["state"] in ("copy", "refused")]
    return said + by_note((row["file"], note) for row in without for note in row["remarks"])


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
    named = [row["file"] for row in rows if row["index"] is not None]
    not_read = ask.desk.hand.do("not_read", folder=str(folder), named=named)
    form = groups(document)
    every = [f for group in form for f in group.fields] + [f for r in rows for f in r["fields"]]
    shown, left = with_errors(every, changed, error)
    fractions = [row["file"] for row in rows if row["look"]["fractions"]]
    by_path = {field.path: field for field in asked_for_unit(shown, fractions)}
    return ask.page(
        "student",
        status=status,
        title=folder.name,
        folder=folder,
        rows=[{**row, "fields": [by_path[f.path] for f in row["fields"]]} for row in rows],
        often=_often(rows),
        not_read=not_read,
        groups=[group.filled(by_path) for group in form] if document else [],
        seen=text_digest(text),
        wrong=left,
        keeps=_keeps(folder) if text and error is None else [],
        sound=bool(text) and error is None,
        job=ask.desk.jobs.of(folder),
        report=last_report.state(folder),
        told=last_report.told(folder),
        unanswered=len(last_report.unanswered(folder)),
        gap=outside(folder, "gap/gap.html") is None,
        said=ask.told(),
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
    if index is not None and "sample_rate" in listed[index]:
        look = {**look, "remarks": [one for one in look["remarks"] if one != NO_CLOCK]}
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
        return _outdated(ask, error.text, changed)
    except SubmissionError as error:
        return _room(ask, status=422, changed=changed, error=error)
    return ask.back(ask.here, "Saved.")


def _outdated(ask: Ask, text: str, changed: Sequence[Field]) -> Response:
    """Show both versions: the file as it is now, and what was typed."""
    now = read_document(text)
    # Of a page older than all that is known, nobody can say what was typed in it.
    known = ask.desk.shown(ask.text("seen"), to=ask.user.name) is not None
    return ask.page(
        "outdated",
        status=409,
        title=f"{NAME} was changed meanwhile",
        name=NAME,
        text=text,
        changed=[(field.label, field.value, field_text(now, field)) for field in changed],
        had="You typed" if known else "Your page had",
        back=ask.here,
    )
