"""Actions on a whole class: grade again, write files, change points from a table, export."""

import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.grades.class_table import may_release
from pipeline.desk.grades.class_table import show as show_class
from pipeline.desk.grades.grading_form import grade_again, show_unfinished
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import scratch_folder
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import read_wishes
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export, export_feedback
from pipeline.output import zip_bytes
from pipeline.words.numbers import count


def take_table(ask: PageRequest) -> Response:
    """Change points from an uploaded table, either all of them or none."""
    shown = ask.class_view
    by = ask.sign()
    with scratch_folder() as scratch:
        table = _store_upload(ask, "table", scratch / "the table")
        if table is None:
            raise ConfigError("choose a file first")
        wishes = read_wishes(table)
    teams = {name: team.submission for name, team in shown.teams.items()}
    meant = []
    for wish in wishes:
        if wish.submission not in teams:
            raise ConfigError(f"line {wish.line}: no submission of this class has this name")
        meant.append(replace(wish, submission=teams[wish.submission]))
    done = ask.gradebook.change_all(meant, by=by)
    message = f"{count(done.teams, 'change')} imported"
    if unchanged := len(meant) - done.teams:
        message += f"; {count(unchanged, 'row')} changed nothing"
    return ask.back(ask.here, f"{message}.")


def accept(ask: PageRequest) -> Response:
    """Mark the ticked teams as reviewed; a team that changed since it was listed is not."""
    shown, by = ask.class_view, ask.sign()
    ticked = [str(name) for name in ask.form.getlist("team")]
    if not ticked or any(name not in shown.teams for name in ticked):
        raise ConfigError("tick at least one team of the class")
    seen = {shown.teams[name].submission: ask.text(f"seen.{name}") for name in ticked}
    done = ask.gradebook.accept_all(seen, by=by)
    message = f"{count(done.teams, 'team')} accepted."
    if done.kept:
        message += f" {count(len(done.kept), 'team')} changed meanwhile: look again."
    return ask.back(ask.here, message)


def release(ask: PageRequest) -> Response:
    """Let students with accounts read their feedback, or hide it again."""
    if not may_release(ask):
        raise HTTPException(
            403, "only the instructor decides when students can read their feedback"
        )
    released = ask.text("do") == "release"
    ask.gradebook.release(released, by=ask.sign())
    message = "Students can read their feedback." if released else "Students can no longer read it."
    return ask.back(f"{ask.here}#work", message)


def export_class(ask: PageRequest) -> Response:
    """Return grades or feedback for a learning platform: one file, or a zip with remarks.

    A zip of feedback files can be uploaded with its remarks: a platform ignores a file whose name
    belongs to no student.
    """
    platform = PLATFORMS.get(ask.text("lms"))
    if platform is None:
        raise HTTPException(400, "there is no such platform")
    what = "feedback" if ask.text("what") == "feedback" else "grades"
    with scratch_folder() as scratch:
        roster = _store_upload(ask, "roster", scratch / "roster.csv")
        out = scratch / "export"
        book, title = ask.gradebook, ask.text("title") or None
        if what == "feedback":
            done = export_feedback(book, platform, out, roster=roster)
        else:
            done = export(book, platform, out, title=title, roster=roster)
        if len(done.files) == 1 and not done.remarks:
            (file,) = done.files
            kind = "text/csv" if file.suffix == ".csv" else "application/zip"
            return _download(file.read_bytes(), file.name, kind=kind)
        if what == "feedback":
            with zipfile.ZipFile(done.files[0]) as packed:
                files = {name: packed.read(name) for name in packed.namelist()}
        else:
            files = {file.relative_to(out).as_posix(): file.read_bytes() for file in done.files}
        if done.remarks:  # remarks may name students, so they go into the zip, not on a page
            told = "".join(f"{remark.text}\n" for remark in done.remarks)
            files["remarks.txt"] = told.encode()
    name = f"{what}-{platform.name}.zip"
    return _download(zip_bytes(files.items()), name, kind="application/zip")


def grade(ask: PageRequest) -> Response:
    """Grade the class again, or for the first time if an earlier attempt did not end."""
    if ask.gradebook.is_graded:
        anonymous, refuse = ask.class_view.rubric.anonymous, partial(show_class, ask)
        return grade_again(ask, is_first=False, anonymous=anonymous, refuse=refuse)
    anonymous, refuse = bool(ask.text("anonymous")), partial(show_unfinished, ask)
    return grade_again(ask, is_first=True, anonymous=anonymous, refuse=refuse)


def _store_upload(ask: PageRequest, name: str, path: Path) -> Path | None:
    """Write an uploaded file to a path; return None if nothing was uploaded."""
    sent = ask.form.get(name)
    if not isinstance(sent, UploadFile) or not sent.filename:
        return None
    path.write_bytes(sent.file.read())  # the limit on requests keeps it small
    return path


def _download(content: bytes, name: str, *, kind: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)
