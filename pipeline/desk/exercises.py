"""What the instructor's room has its worker do: benches with hidden effects, and their solutions.

A bench is what a form says of one: `preset`, or the `m`, `c` and `k` of an own chain as typed.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.errors import ConfigError
from pipeline.output import new_folder, own_folder
from pipeline.plant.nonlinear.effects import Parameter, find_effect
from pipeline.submission import load_submission
from pipeline.synthesis.hidden import HiddenBench, default_values, prepare_bench, usual_term

Progress = Callable[[str], None]
MOST_FOLDERS = 500
SLIDE = 1.0  # decades that a slider goes to each side of the usual size

_OWN = "own chain"
_BETWEEN = re.compile(r"[\s,;]+")


def exercise(
    bench: Mapping[str, str], chosen: Sequence[Mapping[str, Any]], *, progress: Progress
) -> dict[str, Any]:
    """Return a bench with each chosen effect as a form shows it, and what is wrong with them."""
    try:
        plain = _bench(bench)
    except ConfigError as error:
        return {"wrong": str(error), "effects": [], "told": []}
    effects = [_shown(plain, entry) for entry in chosen]
    try:
        told, wrong = _bench(bench, [one["hide"] for one in effects]).told, ""
    except ConfigError as error:
        told, wrong = (), str(error)
    return {"wrong": wrong, "effects": effects, "told": list(told)}


def effect_svg(bench: Mapping[str, str], hide: str, *, progress: Progress) -> str:
    """Return the picture of an effect on a bench: its fingerprint, a run with and without it."""
    from pipeline.report.effects.page import effect_picture
    from pipeline.report.figures.style import drawing
    from pipeline.report.figures.svg import plain_svg

    hidden = _bench(bench, [hide])
    with drawing():
        picture = effect_picture(hidden.effects[-1], hidden.chain, bench=hidden.name, number=1)
    return plain_svg(picture.svg)


def simulate(
    bench: Mapping[str, str],
    hide: Sequence[str],
    out: str,
    folders: int,
    seed: int,
    reported: bool,
    *,
    progress: Progress,
) -> list[str]:
    """Write an exercise, or one in each of so many folders, seeds counting up; return them."""
    from pipeline.synthesis.hidden import write_bench

    hidden, root = _bench(bench, hide), new_folder(Path(out))
    width = len(str(folders))
    made = [root / f"{i + 1:0{width}d}" for i in range(folders)] if folders > 1 else [root]
    for i, folder in enumerate(made):
        progress(f"exercise {i + 1} of {folders}")
        write_bench(folder, hidden, seed=seed + i, reported=reported)
    return [str(folder) for folder in made]


def solution(folder: str, *, progress: Progress) -> None:
    """Write the reference of a submission into its own folder."""
    from pipeline.report.solution.write import make_solution

    submission = load_submission(Path(folder))
    make_solution(submission, own_folder(submission.folder, "solution"), progress=progress)


def _bench(bench: Mapping[str, str], hide: Sequence[str] = ()) -> HiddenBench:
    if preset := bench.get("preset"):
        return prepare_bench(preset=preset, hide=hide)
    chain = {name: _numbers(name, bench.get(name, "")) for name in ("m", "c", "k")}
    with TemporaryDirectory() as folder:
        path = Path(folder) / _OWN
        path.write_text(json.dumps({"chain": chain}), encoding="utf-8")
        try:
            return prepare_bench(model=path, hide=hide)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"--model {path}", _OWN)) from None


def _numbers(name: str, typed: str) -> list[float]:
    try:
        return [float(text) for text in _BETWEEN.split(typed.strip()) if text]
    except ValueError:
        raise ConfigError(f"{_OWN}: {name} needs numbers with blanks between them") from None


def _shown(bench: HiddenBench, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an effect with its sizes: those typed, else those at which it shows."""
    effect, chain = find_effect(entry["key"]), bench.chain
    places = {
        "input": [],
        "cart": list(range(1, chain.n + 1)),
        "spring": [j for j, k in enumerate(chain.k, start=1) if k > 0],
    }[effect.place]
    usual = usual_term(effect, chain, travel=bench.travel).place
    place = next((at for at in places if str(at) == entry["place"]), usual)
    sizes = default_values(effect, chain, place=place, travel=bench.travel)
    parameters = [
        _size(p, sizes[p.name], entry["sizes"].get(p.name, {}), bench)
        for p in effect.parameters
        if p.reported
    ]
    where = [f"{effect.place}={place}"] if places else []
    pairs = [f"{p['name']}={p['value']}" for p in parameters]
    return {
        "key": effect.key,
        "title": effect.title,
        "sentence": effect.sentence,
        "of": effect.place,
        "place": place,
        "places": places,
        "parameters": parameters,
        "hide": f"{effect.key}:{','.join(where + pairs)}",
    }


def _size(
    parameter: Parameter, usual: float, typed: Mapping[str, str], bench: HiddenBench
) -> dict[str, Any]:
    """Return one parameter: a slider that was moved counts, else what was typed, else the usual."""
    none = parameter.neutral or 0.0
    value = typed.get("value", "") if typed.get("value") != typed.get("usual") else ""
    if typed.get("slide", "") != typed.get("was", ""):
        slide = _number(typed.get("slide", "")) or 0.0
        value = f"{none + (usual - none) * 10 ** max(-SLIDE, min(SLIDE, slide)):.3g}"
    value = value or f"{usual:.3g}"
    times = ((_number(value) or none) - none) / (usual - none)
    slide = max(-SLIDE, min(SLIDE, math.log10(times))) if times > 0 else 0.0
    return {
        "name": parameter.name,
        "symbol": parameter.symbol,
        "unit": parameter.unit_text(position=bench.position_unit, input=bench.input_unit),
        "value": value,
        "usual": f"{usual:.3g}",
        "slide": f"{round(slide, 2) + 0.0:g}",
    }


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
