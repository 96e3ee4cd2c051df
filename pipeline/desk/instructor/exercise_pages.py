"""The instructor's room: exercises with hidden effects, solutions, and the catalogue of effects."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

from pipeline.desk.browse import free_path
from pipeline.desk.exercises import SLIDE, key_of
from pipeline.desk.form_input import keep_refusal, read_path, read_whole_number
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_drawing
from pipeline.errors import ConfigError
from pipeline.output import new_folder
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from pipeline.report.effect_texts import catalogue_data
from pipeline.simulated.answer_key import MOST_PERCENT
from pipeline.submission.load import NAME, file_problem
from pipeline.words.math import to_text

_SHOWN_ON = "throne-2dof"  # the smallest bench with a spring between two carts


def show(ask: PageRequest) -> Response:
    """Show the form as filled in, with a picture of every chosen effect."""
    return _show_form(ask, *_check_exercise(ask), wrong={})


def _show_form(
    ask: PageRequest,
    bench: Mapping[str, str],
    found: Mapping[str, Any],
    *,
    wrong: Mapping[str, str],
) -> Response:
    """Show the form as filled in.

    Parameters
    ----------
    wrong : why a field was refused, by name of the field.
    """
    sent = ask.sent
    pictures = [_write_picture_url(bench, one["hide"]) for one in found["effects"]]
    return ask.page(
        "exercises",
        status=422 if wrong else 200,
        title="Exercises",
        bench=bench,
        found=found,
        chosen=[effect["key"] for effect in found["effects"]],
        shown=list(zip(found["effects"], pictures, strict=True)),
        out=str(sent.get("out", free_path((ask.user.workshop or ask.desk.root) / "exercise"))),
        folders=str(sent.get("folders", "1")),
        seed=str(sent.get("seed", "0")),
        vary=str(sent.get("vary", "0")),
        reported=bool(sent.get("reported")),
        wrong=wrong,
        presets=sorted(PRESETS),
        catalogue=CATALOGUE,
        slide=SLIDE,
    )


def draw(ask: PageRequest) -> Response:
    """Draw what an effect does."""
    svg = ask.desk.workers.do("draw_effect", bench=_read_bench(ask), hide=ask.text("hide"))
    return show_drawing(svg)


def make(ask: PageRequest) -> Response:
    """Start the task that makes an exercise, or one for each team of a class."""
    bench, found = _check_exercise(ask)
    wrong = {"found": found["wrong"]} if found["wrong"] else {}
    with keep_refusal("out", wrong):
        out = new_folder(_read_folder(ask))
        if not out.parent.is_dir():
            raise ConfigError(f"{out}: the folder {out.parent} does not exist")
    with keep_refusal("folders", wrong):
        folders = read_whole_number(ask.text("folders"), name="folders", least=1, most=500)
    with keep_refusal("seed", wrong):
        seed = read_whole_number(ask.text("seed"), name="seed", least=0, most=2**31)
    with keep_refusal("vary", wrong):
        typed = ask.text("vary") or "0"
        vary = read_whole_number(typed, name="percent", least=0, most=int(MOST_PERCENT))
    if wrong:
        return _show_form(ask, bench, found, wrong=wrong)
    ask.desk.jobs.start(
        "make_exercises",
        title="The exercise",
        place=out,
        bench=bench,
        hide=[one["hide"] for one in found["effects"]],
        out=str(out),
        seeds=list(range(seed, seed + folders)),
        reported=bool(ask.text("reported")),
        vary=vary,
    )
    return RedirectResponse(f"/exercises/made?{urlencode({'out': out})}", status_code=303)


def show_made(ask: PageRequest) -> Response:
    """Show the progress of an exercise, or the exercise when it is finished."""
    out = _read_folder(ask)
    job = ask.desk.jobs.of(out)
    if job is None or job.task[0] != "make_exercises":
        raise HTTPException(404, "no exercise was made there")
    arguments = job.task[1]
    # The job numbers its folders in this order; a stopped job has made only the first ones.
    folders = [out] if len(arguments["seeds"]) == 1 else sorted(out.glob("*/"))
    made = [
        (folder, seed)
        for folder, seed in zip(folders, arguments["seeds"], strict=False)
        if (folder / NAME).is_file()
    ]
    what: Mapping[str, Any] = {"sentences": (), "files": (), "records": ()}
    if job.over and made:
        bench, hide = arguments["bench"], arguments["hide"]
        what = ask.desk.workers.do(
            "describe_exercise", bench=bench, hide=hide, folder=str(made[0][0])
        )
    key = key_of(out) if arguments["vary"] else None
    return ask.page(
        "made",
        title=f"Exercise {out.name}",
        out=out,
        job=job,
        made=made,
        bench=arguments["bench"],
        key=key,
        **what,
    )


def stop(ask: PageRequest) -> Response:
    """Stop making exercises."""
    out = _read_folder(ask)
    ask.stop(out)
    return RedirectResponse(f"/exercises/made?{urlencode({'out': out})}", status_code=303)


def show_solution(ask: PageRequest) -> Response:
    """Show the solution of a folder, or the progress of making it."""
    folder = ask.folder()
    there = file_problem(folder, "solution/solution.html") is None
    return ask.page("solution", title=f"Solution of {folder.name}", there=there)


def show_catalogue(ask: PageRequest) -> Response:
    """Show the catalogue of effects."""
    bench = {"preset": _SHOWN_ON}
    entries = [
        entry
        | {
            "law": to_text(effect.formula),
            "picture": _write_picture_url(bench, effect.key),
        }
        for effect, entry in zip(CATALOGUE, catalogue_data(CATALOGUE), strict=True)
    ]
    return ask.page("effects", title="Effects beyond the linear chain", entries=entries)


def _check_exercise(ask: PageRequest) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the bench as typed, and the worker's check of the bench and its effects."""
    bench = _read_bench(ask)
    known = {effect.key: effect for effect in CATALOGUE}
    chosen = [
        {
            "key": key,
            "place": ask.text(f"{key}.place"),
            "sizes": {
                name: {
                    part: ask.text(f"{key}.{name}.{part}")
                    for part in ("value", "usual", "slide", "was")
                }
                for name in known[key].names
            },
        }
        for key in dict.fromkeys(ask.sent.getlist("effect"))
        if isinstance(key, str) and key in known
    ]
    return bench, ask.desk.workers.do("check_exercise", bench=bench, chosen=chosen)


def _read_bench(ask: PageRequest) -> dict[str, str]:
    bench = {name: ask.text(name) for name in ("preset", "m", "c", "k")}
    if "preset" not in ask.sent:
        bench["preset"] = _SHOWN_ON
    return bench


def _write_picture_url(bench: Mapping[str, str], hide: str) -> str:
    return f"/exercises/picture.svg?{urlencode({**bench, 'hide': hide})}"


def _read_folder(ask: PageRequest) -> Path:
    wanted = "enter a new or empty folder for the exercise"
    return read_path(ask.text("out"), wanted=wanted, inside=ask.user.workshop)
