"""The form that starts a grading, the first one or a further one: what to grade, and how."""

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from filecmp import cmp
from pathlib import Path, PurePosixPath

from starlette.datastructures import UploadFile
from starlette.responses import Response

from pipeline.desk.browse import free_path
from pipeline.desk.form_input import keep_refusal, read_path
from pipeline.desk.home import enter
from pipeline.desk.instructor.rubric_list import own_rubrics, shipped_rubrics
from pipeline.desk.jobs import Busy
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import scratch_folder
from pipeline.desk.users import Place, User, name_place
from pipeline.errors import ConfigError
from pipeline.grading.batch.grade_class import refuse_submission
from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.intake.find import fit_name
from pipeline.grading.intake.repairs import Run, read_run, save_run
from pipeline.output import OWNERS_FOLDER, named_folder, new_folder, own_folder
from pipeline.processes import Failed
from pipeline.submission.toml import quote

_UPLOADS = "handed-in"  # folder for uploaded zip files, in the folder of the class
_OUT = "grades"  # suggested name for the folder of a new class


@dataclass(frozen=True, kw_only=True)
class GradingForm:
    """The form as a page shows it.

    Attributes
    ----------
    paths : folders and zip files, one per line.
    known : number of paths of the last grading if they are hidden, otherwise 0.
    lateness : file of the table of days late, or "".
    out : folder of a new class; "" if the class has one.
    is_first : whether the class is not graded yet, so that it may still become anonymous.
    rubrics : rubrics to choose from: what is typed for each, and its title.
    wrong : why a field was refused, by name of the field.
    """

    paths: str = ""
    known: int = 0
    rubric: str = ""
    lateness: str = ""
    out: str = ""
    anonymous: bool = False
    is_first: bool = False
    rubrics: Sequence[tuple[str, str]] = ()
    wrong: Mapping[str, str] = field(default_factory=dict)


def last_run(user: User, place: Place) -> Run | None:
    """Return what was graded last in a class; None if this is not known, or not for this person."""
    return read_run(place) if isinstance(place, Path) and user.owns else None


def fill_form(ask: PageRequest, *, named: bool, is_first: bool = False) -> GradingForm:
    """Return the form of a class with what was graded last.

    Parameters
    ----------
    named : whether names are shown. The paths of an anonymous class may contain names.
    """
    run = last_run(ask.user, ask.place_or_404()) or Run(paths=(), rubric="")
    return GradingForm(
        paths="\n".join(run.paths) if named else "",
        known=0 if named else len(run.paths),
        rubric=run.rubric,
        lateness=run.lateness,
        anonymous=bool(run.options.get("anonymous")),
        is_first=is_first,
        rubrics=_list_rubrics(ask.user),
    )


def show_new(ask: PageRequest) -> Response:
    """Show the form of a class that does not exist yet."""
    out = free_path(ask.desk.root / _OUT).name
    return _show(ask, GradingForm(out=out, is_first=True, rubrics=_list_rubrics(ask.user)))


def show_unfinished(ask: PageRequest, form: GradingForm | None = None) -> Response:
    """Show the progress of the first grading of a class, or the form to start it again."""
    run = last_run(ask.user, ask.place_or_404())
    named = not (run and run.options.get("anonymous"))
    return _show(ask, form or fill_form(ask, named=named, is_first=True))


def grade_new(ask: PageRequest) -> Response:
    """Start the first grading of a class in a new folder, and open the class."""
    wrong: dict[str, str] = {}
    with scratch_folder() as scratch:
        run = _read_run(ask, ask.text("paths").splitlines(), scratch=scratch, wrong=wrong)
        out = _read_new_class(ask, run, wrong=wrong)
        wrong |= _check_kept(run, scratch, out) if out else {}
        if out is None or wrong:
            return _show(ask, _typed(ask, wrong=wrong, is_first=True))
        if (job := ask.desk.jobs.of(out)) and not job.over:
            return _open_class(ask, out, "This class is being graded already.")
        out.mkdir(OWNERS_FOLDER, exist_ok=True)
        Gradebook(out, create=True).close()  # so that the folder is known as that of a class
        run = _keep_uploads(run, scratch, out)
    answer = _open_class(ask, out)
    start_grading(ask, run, out)
    save_run(out, run)  # so that a grading that does not end can be continued
    return answer


def _open_class(ask: PageRequest, out: Path, *messages: str) -> Response:
    """Open a class at the desk, and return an answer that leads to its page."""
    address = enter(ask.user, out)
    answer = ask.back(address, *messages)
    return ask.go(address) if "hx-request" in ask.request.headers else answer


def grade_again(
    ask: PageRequest,
    *,
    is_first: bool,
    anonymous: bool,
    refuse: Callable[[GradingForm], Response],
) -> Response:
    """Start a further grading of a class; unchanged submissions keep their results.

    Parameters
    ----------
    is_first : whether no earlier grading ended.
    refuse : function that shows the page of the class with a refused form.
    """
    folder, wrong = ask.folder(), dict[str, str]()
    before = read_run(folder) or Run(paths=(), rubric="")
    with scratch_folder() as scratch:
        paths = ask.text("paths").splitlines() or ([] if _uploads(ask) else before.paths)
        run = _read_run(ask, paths, scratch=scratch, wrong=wrong, skip=folder)
        wrong |= _check_kept(run, scratch, folder)
        if wrong:
            hidden = (anonymous or before.options.get("anonymous")) and not ask.text("paths")
            if hidden and "paths" in wrong:  # the reason may contain names
                wrong["paths"] = "cannot be graded; run cartlab grade in a terminal to see why"
            form = _typed(ask, wrong=wrong, is_first=is_first)
            return refuse(replace(form, known=len(before.paths) if hidden else 0))
        if (job := ask.job) and not job.over and _uploads(ask):
            raise Busy(f"{job.title} is running in this folder: wait until it ends")
        run = _keep_uploads(run, scratch, folder)
    run = replace(run, options={**before.options, "anonymous": anonymous})
    start_grading(ask, run, folder)
    if is_first:
        save_run(folder, run)
    return ask.back(f"{ask.here}#work")


def start_grading(ask: PageRequest, run: Run, folder: Path) -> None:
    """Start a grading. When it ends, it saves what was graded.

    Raises
    ------
    Busy : another job is running in the folder.
    """
    arguments = {"folder": str(folder), **asdict(run)}
    ask.desk.jobs.start("grade_submissions", title="Grading", place=folder, **arguments)


def _show(ask: PageRequest, form: GradingForm) -> Response:
    place = ask.place
    title = name_place(place) if place else "Grade a class"
    return ask.page("grading", status=422 if form.wrong else 200, title=title, form=form)


def _list_rubrics(user: User) -> list[tuple[str, str]]:
    """Return the shipped rubrics by their names, and the person's own by their paths."""
    shipped = [(one.name, one.rubric) for one in shipped_rubrics()]
    own = [(str(one.path), one.rubric) for one in own_rubrics(user)]
    return [(typed, rubric.title or "") for typed, rubric in (*shipped, *own) if rubric]


def _typed(ask: PageRequest, *, wrong: Mapping[str, str], is_first: bool) -> GradingForm:
    """Return the form as it was typed."""
    if _uploads(ask) and "hx-request" not in ask.request.headers:
        wrong = {"files": "choose the files once more", **wrong}
    return GradingForm(
        paths=ask.text("paths"),
        rubric=ask.text("rubric"),
        lateness=ask.text("lateness"),
        out=ask.text("out"),
        anonymous=bool(ask.text("anonymous")),
        is_first=is_first,
        rubrics=_list_rubrics(ask.user),
        wrong=wrong,
    )


# ------------------------------------------------------------------- what is typed and sent


def _read_run(
    ask: PageRequest,
    paths: Sequence[str],
    *,
    scratch: Path,
    wrong: dict[str, str],
    skip: Path | None = None,
) -> Run:
    """Return what the form asks to grade; uploaded files are still in the scratch folder.

    Parameters
    ----------
    wrong : receives the reason for each refused field.
    skip : folder of the class, whose content is not graded.
    """
    found: list[str] = []
    files = _store_uploads(ask, scratch, wrong=wrong)
    with keep_refusal("paths", wrong):
        wanted = "choose zip files, or enter a folder"
        found = [str(read_path(path, wanted=wanted)) for path in paths if path.strip()]
        if not found and not files and "files" not in wrong:
            raise ConfigError(wanted)
    rubric, lateness = (_find(ask.text(name)) for name in ("rubric", "lateness"))
    asked = {"files": files, "paths": found, "rubric": rubric, "lateness": lateness}
    try:
        refused = ask.desk.workers.do("check_grading", **asked, skip=str(skip or ""))
    except Failed as error:  # a file ended the process that checked it
        refused = {"files" if files else "paths": str(error)}
    for name, why in refused.items():
        wrong.setdefault(name, why.replace(f"{scratch.resolve()}{os.sep}", ""))
    options = {"anonymous": bool(ask.text("anonymous"))}
    return Run(paths=(*found, *files), rubric=rubric, lateness=lateness, options=options)


def _read_new_class(ask: PageRequest, run: Run, *, wrong: dict[str, str]) -> Path | None:
    """Return the folder for a new class: new, empty, or that of a grading that did not end.

    A name without a folder is beside the first submission that was typed.
    """
    typed = ask.text("out") or _OUT
    beside = Path(run.paths[0]).parent if ask.text("paths") and run.paths else ask.desk.root
    with keep_refusal("out", wrong):
        is_name = not typed.startswith("~") and not Path(typed).is_absolute()
        wanted = "enter a name for the folder of the grades"
        out = named_folder(read_path(str(beside / typed) if is_name else typed, wanted=wanted))
        if not out.parent.is_dir():
            raise ConfigError(f"{out}: the folder {out.parent} does not exist")
        refuse_submission(out)
        if not (out / FILE).is_file():
            return new_folder(out)
        with Gradebook(out) as book:
            if book.is_graded:
                raise ConfigError(f"{out}: holds a graded class; open it, and grade again there")
        return out
    return None


def _uploads(ask: PageRequest) -> list[UploadFile]:
    sent = ask.form.getlist("files")
    return [one for one in sent if isinstance(one, UploadFile) and one.filename]


def _store_uploads(ask: PageRequest, scratch: Path, *, wrong: dict[str, str]) -> list[str]:
    """Write uploaded files into a folder, under names that every system accepts."""
    stored: dict[str, None] = {}
    for sent in _uploads(ask):
        name = PurePosixPath((sent.filename or "").replace("\\", "/"))
        path = scratch / f"{fit_name(name.stem)}.zip"
        if name.suffix.lower() != ".zip":
            wrong["files"] = f"{quote(name.name)}: choose zip files only"
            continue
        if str(path) in stored:
            wrong["files"] = f"{quote(name.name)}: choose zip files with different names"
            continue
        with path.open("xb") as file:
            shutil.copyfileobj(sent.file, file)  # the limit on requests keeps it small
        stored[str(path)] = None
    return list(stored)


def _check_kept(run: Run, scratch: Path, folder: Path) -> dict[str, str]:
    """Return a refusal if an uploaded file would replace another one of its name in the class."""
    for path in map(Path, run.paths):
        kept = folder / _UPLOADS / path.name
        if path.parent == scratch and kept.exists() and not cmp(path, kept, shallow=False):
            why = f"{quote(path.name)}: another file of this name was uploaded before; rename it"
            return {"files": why}
    return {}


def _keep_uploads(run: Run, scratch: Path, folder: Path) -> Run:
    """Move uploaded files from the scratch folder into the folder of the class."""
    kept = own_folder(folder, _UPLOADS)
    paths = []
    for path in map(Path, run.paths):
        if path.parent == scratch:
            kept.mkdir(OWNERS_FOLDER, exist_ok=True)
            path = Path(shutil.move(path, kept / path.name))
        paths.append(str(path))
    return replace(run, paths=tuple(paths))


def _find(typed: str) -> str:
    """Return the whole path of an existing file; other text, such as a shipped name, as it is."""
    try:
        path = Path(typed).expanduser()
        return str(path.resolve()) if typed and path.exists() else typed
    except (OSError, RuntimeError, ValueError):
        return typed
