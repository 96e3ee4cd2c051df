"""The student's room: files, form, zip. The files in the folder are the only stored state."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import tomlkit
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk import last_report
from pipeline.desk.ask import Ask, Message
from pipeline.desk.seeing import sees_check
from pipeline.desk.student.files import put_aside, take_uploads
from pipeline.desk.student.form import (
    Field,
    clear_marks,
    fill_experiment,
    fill_form,
    find_changes,
    read_document,
    read_value,
    remove_experiment,
    write_fields,
)
from pipeline.desk.student.handin import list_held, list_missing, pack
from pipeline.desk.student.room import Room, read_room
from pipeline.desk.student.rows import describe_all, gather_remarks, group_rows
from pipeline.desk.typed import read_whole_number
from pipeline.errors import SubmissionError
from pipeline.lock import lock_when_free
from pipeline.processes import Failed
from pipeline.submission.edit import Outdated, edit_submission, submission_text
from pipeline.submission.load import NAME, file_problem, list_experiments, posix
from pipeline.words.numbers import by_note, count

_FILES, _SET_UP = "files", "details"  # parts of pages, by their HTML ids


def show(ask: Ask) -> Response:
    """Show the room in its current state."""
    return _show_page(ask)


def upload(ask: Ask) -> Response:
    """Store uploaded files, and add tables for them to `submission.toml`."""
    folder, items = ask.folder(), ask.form.getlist("files")
    sent = [(i.filename, i.file) for i in items if isinstance(i, UploadFile) and i.filename]
    messages = take_uploads(sent, folder, workers=ask.desk.workers)
    return _go_back(ask, [*messages, *_fill_tables(ask, folder)], _FILES)


def set_aside(ask: Ask) -> Response:
    """Move a recording that no table names out of `data/`."""
    folder, file = ask.folder(), ask.text("file")
    if file not in ask.desk.workers.do("list_files", folder=str(folder)):
        raise HTTPException(404, "there is no such recording")
    with lock_when_free(folder):
        document = read_document(submission_text(folder) if (folder / NAME).exists() else "")
        if any(posix(str(table.get("file", ""))) == file for table in list_experiments(document)):
            raise SubmissionError(f"{file}: {NAME} uses it; remove it there first")
        message = put_aside(file, folder)
    return _go_back(ask, [Message(message)], _FILES)


def fill(ask: Ask) -> Response:
    """Add tables for data files without a table."""
    return _go_back(ask, _fill_tables(ask, ask.folder()), _FILES)


def save(ask: Ask) -> Response:
    """Write the form into `submission.toml`."""
    fields = [field for group in fill_form(_read_shown(ask)) for field in group.fields]
    changed = find_changes(fields, ask.form, ask.form.getlist)
    return _edit(ask, lambda document: write_fields(document, changed), changed, place=_SET_UP)


def save_experiment(ask: Ask) -> Response:
    """Write one row of the list of recordings into `submission.toml`, or remove its table."""
    index = ask.request.path_params["index"]
    if ask.text("remove"):
        return _edit(ask, lambda document: remove_experiment(document, index), (), place=_FILES)
    shown = _read_shown(ask)
    changed = find_changes(fill_experiment(shown, index), ask.form, ask.form.getlist)
    says_carts = any(field.path.endswith(".carts") for field in changed)
    answered = _list_doubts(ask, shown, index) if says_carts else ()

    def change(document: tomlkit.TOMLDocument) -> None:
        write_fields(document, changed)
        clear_marks(document, index, answered)

    return _edit(ask, change, changed, place=_FILES)


def answer_together(ask: Ask) -> Response:
    """Write the same answer about held carts into the tables of several recordings."""
    shown, carts = _read_shown(ask), ask.text("carts")
    most = len(list_experiments(shown)) - 1
    numbers = [
        read_whole_number(str(typed), name="recording", least=0, most=most)
        for typed in ask.form.getlist("recording")
    ]
    changed = [
        replace(field, value=carts)
        for number in numbers
        for field in fill_experiment(shown, number)
        if field.path.endswith(".carts")
    ]
    answered = {number: _list_doubts(ask, shown, number) for number in numbers}

    def change(document: tomlkit.TOMLDocument) -> None:
        write_fields(document, changed)
        for number, doubts in answered.items():
            clear_marks(document, number, doubts)

    return _edit(ask, change, changed, place=_FILES)


def start_hand_in(ask: Ask) -> Response:
    """Make the report again if a source has changed; then show the hand-in page."""
    if not sees_check(ask.user, ask.folder()) and last_report.find_state(ask.folder()) != "current":
        ask.start("make_report", title="The report")
    return ask.back(f"{ask.here}hand-in")


def show_hand_in(ask: Ask) -> Response:
    """Show what is done, what is missing, what was assumed, and the content of the zip."""
    folder, room = ask.folder(), read_room(ask)
    keeps = list_missing(folder)
    names = [] if keeps else list_held(folder, report=not sees_check(ask.user, ask.folder()))
    return ask.page(
        "handin",
        title=f"Hand in: {folder.name}",
        room=room,
        keeps=keeps,
        files=[(name, (folder / name).stat().st_size) for name in names],
        unanswered=[] if room.facts.check else last_report.list_unanswered(folder),
        authors=_list_authors(room),
    )


def download_hand_in(ask: Ask) -> Response:
    """Return the zip."""
    name = f"{ask.folder().name}.zip"
    # A name in plain letters; the real name follows in the form of RFC 5987.
    plain = re.sub(r"[^A-Za-z0-9_.-]", "-", name)
    disposition = f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"
    headers = {"Content-Disposition": disposition}
    made_of = last_report.stat_sources(ask.folder())
    packed = pack(ask.folder(), report=not sees_check(ask.user, ask.folder()))
    ask.desk.handed[ask.folder()] = made_of
    return Response(packed, media_type="application/zip", headers=headers)


# ------------------------------------------------------------------------------- parts


def _read_shown(ask: Ask) -> dict[str, Any]:
    """Return the version of `submission.toml` from which the form was filled in."""
    text = ask.desk.shown(ask.text("seen"), to=ask.user.name)
    return read_document(submission_text(ask.folder()) if text is None else text)


def _list_authors(room: Room) -> list[str]:
    """Return the authors in the form."""
    who = [f.value for group in room.groups for f in group.fields if f.path == "authors"]
    return [line for value in who for line in value.splitlines() if line.strip()]


def _list_doubts(ask: Ask, document: Mapping[str, Any], index: int) -> Sequence[str]:
    """Return the doubts about the carts of an experiment."""
    files = [posix(str(table.get("file", ""))) for table in list_experiments(document)]
    looks = describe_all(ask, ask.folder(), document)
    return looks[files[index]]["unsure"] if index < len(files) and files[index] in looks else ()


def _fill_tables(ask: Ask, folder: Path) -> list[Message]:
    """Add tables for new files; return messages."""
    try:
        rows = ask.desk.workers.do("fill_tables", folder=str(folder))
    except Failed as error:
        return [Message(str(error), "refused")]
    new = [row["file"] for row in rows if row["state"] in ("new", "completed")]
    messages = [Message(f"{count(len(new), 'file')} written into {NAME}.")] if new else []
    without = [row for row in rows if row["state"] in ("copy", "refused")]
    notes = by_note((row["file"], note) for row in without for note in row["remarks"])
    return messages + [Message(note, "refused") for note in notes]


def _go_back(ask: Ask, messages: Iterable[Message], place: str) -> Response:
    """Return to the page from which the request came, and show messages at the same part of it."""
    return ask.back(f"{ask.here}#{place}", *messages, place=place)


def _show_page(
    ask: Ask,
    *,
    status: int = 200,
    changed: Sequence[Field] = (),
    error: SubmissionError | None = None,
) -> Response:
    """Show the room; fields with errors show what was typed."""
    folder, room = ask.folder(), read_room(ask, changed=changed, error=error)
    named = [row.file for row in room.rows if row.index is not None]
    return ask.page(
        "student",
        status=status,
        title=folder.name,
        room=room,
        file_groups=group_rows(room.rows),
        often=gather_remarks(room.rows),
        not_read=ask.desk.workers.do("list_not_read", folder=str(folder), named=named),
        keeps=list_missing(folder) if room.facts.sound else [],
        gap=file_problem(folder, "gap/gap.html") is None,
    )


def _edit(
    ask: Ask,
    change: Callable[[tomlkit.TOMLDocument], None],
    changed: Sequence[Field],
    *,
    place: str,
) -> Response:
    """Change `submission.toml`; show typed values again if they are invalid or outdated.

    Parameters
    ----------
    changed : the fields that `change` writes.
    place : part of the page from which the request came.
    """
    folder = ask.folder()
    try:
        edit_submission(folder, change, seen=ask.text("seen") or "nothing")
    except Outdated as error:
        return _show_outdated(ask, error.text, changed)
    except SubmissionError as error:
        return _show_page(ask, status=422, changed=changed, error=error)
    return _go_back(ask, [Message("Saved.")], place)


def _show_outdated(ask: Ask, text: str, changed: Sequence[Field]) -> Response:
    """Show both versions: the current file, and what was typed."""
    now = read_document(text)
    # If the page is too old, nobody can tell which of its values were typed.
    known = ask.desk.shown(ask.text("seen"), to=ask.user.name) is not None
    return ask.page(
        "outdated",
        status=409,
        title=f"{NAME} was changed meanwhile",
        name=NAME,
        text=text,
        changed=[(field.label, field.value, read_value(now, field)) for field in changed],
        had="You typed" if known else "Your page had",
        back=ask.here,
    )
