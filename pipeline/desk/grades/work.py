"""What is done with a whole class: graded again, written, changed from a table, exported."""

import zipfile
from io import BytesIO
from pathlib import Path
from typing import get_args

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.grades.room import a_class
from pipeline.desk.grades.team import signed
from pipeline.desk.scratch import scratch_folder
from pipeline.desk.state import Ask
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.override import Wish, read_wishes
from pipeline.grading.intake.lms_names import Platform
from pipeline.grading.publish.export import export
from pipeline.report.numbers import count

_REGRADED = ("paths", "rubric", "lateness")


def take_table(ask: Ask) -> Response:
    """Change points as a table says, all of it or nothing."""
    shown = a_class(ask)
    by = signed(ask)
    with scratch_folder() as scratch:
        wishes = read_wishes(_uploaded(ask, "table", scratch / "the table"))
    teams = {name: team.submission for name, team in shown.teams.items()}
    meant = []
    for wish in wishes:
        if wish.submission not in teams:
            raise ConfigError(f"line {wish.line}: no submission of this class is called so")
        meant.append(
            Wish(line=wish.line, submission=teams[wish.submission], criterion=wish.criterion,
                 points=wish.points, why=wish.why)
        )  # fmt: skip
    new = ask.desk.books.book(ask.grades()).change_all(meant, by=by)
    said = f"{count(new, 'change')} taken over"
    if unchanged := len(meant) - new:
        said += f", {unchanged} were so before"
    return ask.back(ask.here, f"{said}.")


def export_class(ask: Ask) -> Response:
    """Return the grades as a learning platform imports them: a table, or a zip with remarks."""
    a_class(ask)
    platform = next((one for one in get_args(Platform) if one == ask.text("lms")), None)
    if platform is None:
        raise HTTPException(400, "there is no such platform")
    with scratch_folder() as scratch:
        own = _uploaded(ask, "roster", scratch / "roster.csv") if _sent(ask, "roster") else None
        out = scratch / "export"
        book = ask.desk.books.book(ask.grades())
        done = export(book, platform, out, title=ask.text("title") or None, roster=own)
        if len(done.files) == 1 and not done.remarks:
            return _download(done.files[0].read_bytes(), done.files[0].name, kind="text/csv")
        packed = BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in done.files:
                archive.write(file, file.relative_to(out).as_posix())
            if done.remarks:  # they name students, which a page need not
                archive.writestr(
                    "remarks.txt", "".join(f"{remark.text}\n" for remark in done.remarks)
                )
    return _download(packed.getvalue(), f"{platform}.zip", kind="application/zip")


def publish(ask: Ask) -> Response:
    """Have `grades.csv`, the class page and everybody's feedback written into the folder."""
    a_class(ask)
    folder = _folder(ask)
    ask.desk.jobs.start("publish", title="Writing", place=folder, folder=str(folder))
    return ask.back(ask.here + "#work")


def regrade(ask: Ask) -> Response:
    """Have the class graded again: what is as it was is not."""
    shown = a_class(ask)
    if not ask.user.owns:
        raise HTTPException(403, "folders of this computer are named by its owner only")
    folder = _folder(ask)
    typed = {name: ask.text(name) for name in _REGRADED}
    if not typed["paths"] or not typed["rubric"]:
        raise ConfigError("name the submissions and the rubric")
    ask.desk.books.asked[folder] = typed
    ask.desk.jobs.start(
        "regrade",
        title="Grading",
        place=folder,
        folder=str(folder),
        paths=typed["paths"].splitlines(),
        rubric=typed["rubric"],
        lateness=typed["lateness"],
        anonymous=shown.rubric.anonymous,
    )
    return ask.back(ask.here + "#work")


def stop(ask: Ask) -> Response:
    """Stop what is under way; what is graded is kept."""
    a_class(ask)
    if job := ask.desk.jobs.of(_folder(ask)):
        job.stop.set()
    return ask.back(ask.here + "#work")


def _folder(ask: Ask) -> Path:
    place = ask.grades()
    if isinstance(place, str):
        raise ConfigError("a class in a database is graded and written by cartlab grade")
    return place


def _sent(ask: Ask, name: str) -> bool:
    sent = ask.form.get(name)
    return isinstance(sent, UploadFile) and bool(sent.filename)


def _uploaded(ask: Ask, name: str, path: Path) -> Path:
    sent = ask.form.get(name)
    if not isinstance(sent, UploadFile) or not sent.filename:
        raise ConfigError("choose a file first")
    path.write_bytes(sent.file.read())  # the guard let no more than a form's bytes pass
    return path


def _download(content: bytes, name: str, *, kind: str) -> Response:
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)
