"""The student's room: files, form, zip. The files in the folder are the only stored state."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from pipeline.desk import last_report
from pipeline.desk.form_input import read_whole_number
from pipeline.desk.page_request import Message, PageRequest
from pipeline.desk.served_files import scratch_folder
from pipeline.desk.student.files import take_uploads
from pipeline.desk.student.form import Fault, fill_experiment, fill_form
from pipeline.desk.student.recording_rows import (
    describe_all,
    gather_remarks,
    group_rows,
)
from pipeline.desk.student.submission_view import SubmissionView, read_room, show_stale
from pipeline.desk.toml_form import Field, find_changes, read_value
from pipeline.processes import Failed
from pipeline.submission.load import NAME, file_problem, list_experiments, posix
from pipeline.words.numbers import count, group_messages

_FILES, _SET_UP = "files", "details"  # parts of pages, by their HTML ids


def upload(ask: PageRequest) -> Response:
    """Store uploaded files, and add tables for them to `submission.toml`."""
    folder, items = ask.folder(), ask.form.getlist("files")
    sent = [(i.filename, i.file) for i in items if isinstance(i, UploadFile) and i.filename]
    messages = take_uploads(sent, folder, workers=ask.desk.workers)
    return _go_back(ask, [*messages, *_fill_tables(ask)], _FILES)


def set_aside(ask: PageRequest) -> Response:
    """Move a recording that no table names out of `data/`."""
    message = ask.do("set_aside", file=ask.text("file"))
    if message is None:
        raise HTTPException(404, "there is no such recording")
    return _go_back(ask, [Message(message)], _FILES)


def fill(ask: PageRequest) -> Response:
    """Add tables for data files without a table."""
    return _go_back(ask, _fill_tables(ask), _FILES)


def save(ask: PageRequest) -> Response:
    """Write the form into `submission.toml`."""
    fields = [field for group in fill_form(_read_shown(ask)) for field in group.fields]
    changed = find_changes(fields, ask.form, ask.form.getlist)
    return _edit(ask, changed, place=_SET_UP)


def save_experiment(ask: PageRequest) -> Response:
    """Write one row of the list of recordings into `submission.toml`, or remove its table."""
    index = ask.request.path_params["index"]
    if ask.text("remove"):
        return _edit(ask, (), place=_FILES, remove=index)
    shown = _read_shown(ask)
    changed = find_changes(fill_experiment(shown, index), ask.form, ask.form.getlist)
    says_carts = any(field.path.endswith(".carts") for field in changed)
    doubts = [(index, _list_doubts(ask, shown, index))] if says_carts else []
    return _edit(ask, changed, place=_FILES, doubts=doubts)


def answer_together(ask: PageRequest) -> Response:
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
    doubts = [(number, _list_doubts(ask, shown, number)) for number in numbers]
    return _edit(ask, changed, place=_FILES, doubts=doubts)


def start_hand_in(ask: PageRequest) -> Response:
    """Make the report again if a source has changed or it has no PDF; then show the page."""
    folder = ask.folder()
    is_whole = file_problem(folder, last_report.PDF) is None
    is_current = is_whole and last_report.find_state(folder) == "current"
    if not ask.sees_check and not is_current:
        ask.start("make_report", title="The report")
    return ask.back(f"{ask.here}hand-in")


def show_hand_in(ask: PageRequest) -> Response:
    """Show what is done, what is missing, what was assumed, and the content of the zip."""
    folder, room = ask.folder(), read_room(ask)
    files = [] if room.keeps else ask.do("list_hand_in", report=not room.facts.check)
    return ask.page(
        "handin",
        title=f"Hand in: {folder.name}",
        room=room,
        files=files,  # name and size of each file in the zip, in bytes
        has_report=any(name == last_report.PDF for name, _ in files),
        authors=_list_authors(room),
    )


def download_hand_in(ask: PageRequest) -> Response:
    """Return the zip."""
    folder = ask.folder()
    name = f"{folder.name}.zip"
    # A name in plain letters; the real name follows in the form of RFC 5987.
    plain = re.sub(r"[^A-Za-z0-9_.-]", "-", name)
    disposition = f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"
    headers = {"Content-Disposition": disposition}
    with ExitStack() as scratch:
        packed = scratch.enter_context(scratch_folder()) / "hand-in.zip"
        made_of = ask.do("pack_hand_in", into=str(packed), report=not ask.sees_check)
        ask.desk.handed[folder] = made_of
        return _Temporary(packed, scratch.pop_all(), headers=headers)


# ------------------------------------------------------------------------------- parts


class _Temporary(FileResponse):
    """A zip file that is removed when it was sent, or when the connection is lost."""

    def __init__(self, path: Path, scratch: ExitStack, *, headers: Mapping[str, str]) -> None:
        super().__init__(path, media_type="application/zip", headers=headers)
        self._scratch = scratch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file, then remove it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._scratch.close()


def _read_shown(ask: PageRequest) -> dict[str, Any]:
    """Return the version of `submission.toml` from which the form was filled in."""
    text = ask.desk.shown(ask.text("seen"), to=ask.user.name)
    if text is None:
        return ask.do("read_folder", check=False)["document"]
    return ask.do("read_document", text=text)


def _list_authors(room: SubmissionView) -> list[str]:
    """Return the authors in the form."""
    who = [f.value for group in room.groups for f in group.fields if f.path == "authors"]
    return [line for value in who for line in value.splitlines() if line.strip()]


def _list_doubts(ask: PageRequest, document: Mapping[str, Any], index: int) -> Sequence[str]:
    """Return the doubts about the carts of an experiment."""
    files = [posix(str(table.get("file", ""))) for table in list_experiments(document)]
    looks = describe_all(ask, ask.folder(), document)
    return looks[files[index]]["unsure"] if index < len(files) and files[index] in looks else ()


def _fill_tables(ask: PageRequest) -> list[Message]:
    """Add tables for new files; return messages."""
    try:
        rows = ask.do("fill_tables")
    except Failed as error:
        return [Message(str(error), "refused")]
    new = [row["file"] for row in rows if row["state"] in ("new", "completed")]
    messages = [Message(f"{count(len(new), 'file')} written into {NAME}.")] if new else []
    without = [row for row in rows if row["state"] in ("copy", "refused")]
    notes = group_messages((row["file"], note) for row in without for note in row["remarks"])
    return messages + [Message(note, "refused") for note in notes]


def _go_back(ask: PageRequest, messages: Iterable[Message], place: str) -> Response:
    """Return to the page from which the request came, and show messages at the same part of it."""
    return ask.back(f"{ask.here}#{place}", *messages, place=place)


def show(
    ask: PageRequest,
    *,
    status: int = 200,
    changed: Sequence[Field] = (),
    fault: Fault | None = None,
) -> Response:
    """Show the room; fields with errors show what was typed."""
    folder, room = ask.folder(), read_room(ask, changed=changed, fault=fault)
    named = [row.file for row in room.rows if row.index is not None]
    return ask.page(
        "student",
        status=status,
        title=folder.name,
        room=room,
        file_groups=group_rows(room.rows),
        often=gather_remarks(room.rows),
        not_read=ask.do("list_not_read", named=named),
        keeps=room.keeps if room.facts.is_valid else [],
        gap=file_problem(folder, "gap/gap.html") is None,
        plotted=not room.facts.check,
    )


def _edit(
    ask: PageRequest,
    changed: Sequence[Field],
    *,
    place: str,
    doubts: Sequence[tuple[int, Sequence[str]]] = (),
    remove: int | None = None,
) -> Response:
    """Change `submission.toml`; show typed values again if they are invalid or outdated.

    Parameters
    ----------
    changed : the fields to write.
    place : part of the page from which the request came.
    doubts, remove : doubts to clear, and table to remove; see `folder_tasks.edit_file`.
    """
    fields = [{"path": one.path, "kind": one.kind, "value": one.value} for one in changed]
    seen = ask.text("seen")
    found = ask.do("edit_file", seen=seen, fields=fields, doubts=doubts, remove=remove)
    if "stale" in found:
        now = ask.do("read_document", text=found["stale"])
        # If the page is too old, nobody can tell which of its values were typed.
        known = ask.desk.shown(seen, to=ask.user.name) is not None
        return show_stale(
            ask,
            NAME,
            found["stale"],
            changed=[(field.label, field.value, read_value(now, field)) for field in changed],
            back=ask.here,
            had="You typed" if known else "Your page had",
        )
    if "fault" in found:
        return show(ask, status=422, changed=changed, fault=Fault(**found["fault"]))
    return _go_back(ask, [Message("Saved.")], place)
