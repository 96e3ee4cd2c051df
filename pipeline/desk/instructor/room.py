"""The instructor's room: exercises with what is hidden in them, solutions, the catalogue."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from starlette.datastructures import FormData, QueryParams
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

from pipeline.desk.exercises import MOST_FOLDERS, SLIDE
from pipeline.desk.pages import served_file
from pipeline.desk.state import Ask
from pipeline.desk.typed import typed_path, whole_number
from pipeline.errors import ConfigError
from pipeline.output import new_folder
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.nonlinear.effects import CATALOGUE
from pipeline.report.effects.words import catalogue_data
from pipeline.report.math.tex import from_tex
from pipeline.report.math.tree import to_text
from pipeline.submission.load import outside

_PICTURE = "default-src 'none'; style-src 'unsafe-inline'; sandbox"
_BENCH = ("preset", "m", "c", "k")
_SIZE = ("value", "usual", "slide", "was")
_SHOWN_ON = "throne-2dof"  # the smallest with a spring between two carts


def show(ask: Ask) -> Response:
    """Show the form as it is filled in, with a picture of every effect that is chosen."""
    sent = ask.request.query_params
    bench, found = _exercise(ask, sent)
    pictures = [_picture_url(bench, one["hide"]) for one in found["effects"]]
    return ask.page(
        "exercises",
        title="Exercises",
        presets=sorted(PRESETS),
        catalogue=CATALOGUE,
        bench=bench,
        found=found,
        shown=list(zip(found["effects"], pictures, strict=True)),
        chosen=[one["key"] for one in found["effects"]],
        slide=SLIDE,
        out=sent.get("out", str((ask.user.workshop or Path.cwd()) / "exercise")),
        folders=sent.get("folders", "1"),
        seed=sent.get("seed", "0"),
        reported=bool(sent.get("reported")),
    )


def picture(ask: Ask) -> Response:
    """Draw what an effect does."""
    sent = ask.request.query_params
    svg = ask.desk.hand.do("effect_svg", bench=_bench(sent), hide=sent.get("hide", ""))
    headers = {"Content-Security-Policy": _PICTURE}
    return Response(svg, media_type="image/svg+xml", headers=headers)


def make(ask: Ask) -> Response:
    """Have the exercise made, or a class of them."""
    bench, found = _exercise(ask, ask.form)
    if found["wrong"]:
        raise ConfigError(found["wrong"])
    out = _place(ask, ask.text("out"))
    if not out.parent.is_dir():
        raise ConfigError(f"{out}: there is no folder {out.parent} to make it in")
    ask.desk.jobs.start(
        "simulate",
        title="The exercise",
        place=new_folder(out),
        bench=bench,
        hide=[one["hide"] for one in found["effects"]],
        out=str(out),
        folders=whole_number(ask.text("folders"), name="folders", least=1, most=MOST_FOLDERS),
        seed=whole_number(ask.text("seed"), name="seed", least=0, most=2**31),
        reported=bool(ask.text("reported")),
    )
    return RedirectResponse(f"/exercises/made?{urlencode({'out': out})}", status_code=303)


def made(ask: Ask) -> Response:
    """Show how far an exercise is."""
    out = _place(ask, ask.request.query_params.get("out", ""))
    job = ask.desk.jobs.of(out)
    if job is None:
        raise HTTPException(404, "no exercise was made there")
    folders = [out] if (out / "submission.toml").is_file() else sorted(out.glob("*/"))
    return ask.page("made", title=f"Exercise {out.name}", out=out, job=job, folders=folders)


def stop(ask: Ask) -> Response:
    """Stop the making."""
    out = _place(ask, ask.text("out"))
    if job := ask.desk.jobs.of(out):
        job.stop.set()
    return RedirectResponse(f"/exercises/made?{urlencode({'out': out})}", status_code=303)


def show_solution(ask: Ask) -> Response:
    """Show the reference of a folder, or how far it is."""
    folder = ask.folder()
    return ask.page(
        "solution",
        title=f"Solution of {folder.name}",
        folder=folder,
        job=ask.desk.jobs.of(folder),
        there=outside(folder, "solution/solution.html") is None,
    )


def make_solution(ask: Ask) -> Response:
    """Have the reference made."""
    folder = ask.folder()
    ask.desk.jobs.start("solution", title="The solution", place=folder, folder=str(folder))
    return RedirectResponse(ask.here, status_code=303)


def solution_file(ask: Ask) -> Response:
    """Return a file of the reference."""
    return served_file(ask.folder(), f"solution/{ask.request.path_params['name']}")


def catalogue(ask: Ask) -> Response:
    """Show what a bench may do beyond the linear chain."""
    bench = {"preset": _SHOWN_ON}
    entries = [
        entry
        | {
            "law": to_text(from_tex(str(entry["equation"]))),
            "picture": _picture_url(bench, entry["effect"]),
        }
        for entry in catalogue_data(CATALOGUE)
    ]
    return ask.page("effects", title="What a bench may do beyond the linear chain", entries=entries)


def _exercise(ask: Ask, sent: FormData | QueryParams) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the bench of a form, and what its worker says of it and of the effects."""
    bench = _bench(sent)
    known = {effect.key: effect for effect in CATALOGUE}
    chosen = [
        {
            "key": key,
            "place": _text(sent, f"{key}.place"),
            "sizes": {
                name: {part: _text(sent, f"{key}.{name}.{part}") for part in _SIZE}
                for name in known[key].names
            },
        }
        for key in dict.fromkeys(sent.getlist("effect"))
        if isinstance(key, str) and key in known
    ]
    return bench, ask.desk.hand.do("exercise", bench=bench, chosen=chosen)


def _bench(sent: FormData | QueryParams) -> dict[str, str]:
    bench = {name: _text(sent, name) for name in _BENCH}
    if "preset" not in sent:
        bench["preset"] = _SHOWN_ON
    return bench


def _text(sent: FormData | QueryParams, name: str) -> str:
    value = sent.get(name, "")
    return value.strip() if isinstance(value, str) else ""


def _picture_url(bench: Mapping[str, str], hide: str) -> str:
    return f"/exercises/picture.svg?{urlencode({**bench, 'hide': hide})}"


def _place(ask: Ask, typed: str) -> Path:
    wanted = "name a folder for the exercise, not there yet or empty"
    return typed_path(typed, wanted=wanted, inside=ask.user.workshop)
