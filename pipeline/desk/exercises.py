"""Tasks of the instructor's room: benches with hidden effects, and their solutions.

A bench is given by the fields of a form: `preset`, or `m`, `c` and `k` of a custom chain, as typed.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.errors import ConfigError
from pipeline.output import new_folder, own_folder
from pipeline.plant.catalogue import find_effect
from pipeline.plant.effect import EffectParameter
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.hidden import default_values, prepare_bench, usual_term
from pipeline.submission import load_submission
from pipeline.words.progress import Progress

SLIDE = 1.0  # decades from the usual size to each end of a slider

_OWN = "custom chain"


def check_exercise(
    bench: Mapping[str, str], chosen: Sequence[Mapping[str, Any]], *, progress: Progress
) -> dict[str, Any]:
    """Return the chosen effects on a bench as a form shows them, or what is wrong with them.

    `about` says what is wrong: the `chain`, `fields` of parameters, which hold the reason, or the
    `effects` together.
    """
    try:
        plain = _prepare(bench)
    except ConfigError as error:
        return {"wrong": str(error), "about": "chain", "effects": [], "sentences": []}
    effects = [_describe_effect(plain, entry) for entry in chosen]
    try:
        sentences, wrong = _prepare(bench, [one["hide"] for one in effects]).effect_sentences, ""
    except ConfigError as error:
        sentences, wrong = (), str(error)
        for one in effects:
            _find_wrong_parameters(bench, one)
            wrong = wrong.replace(f"--hide {one['hide']}", one["title"])
    at_fields = any(p["wrong"] for one in effects for p in one["parameters"])
    about = "" if not wrong else "fields" if at_fields else "effects"
    return {"wrong": wrong, "about": about, "effects": effects, "sentences": list(sentences)}


def _find_wrong_parameters(bench: Mapping[str, str], one: Mapping[str, Any]) -> None:
    """Give the reason why an effect is refused to its parameters whose usual value changes it."""
    if not (wrong := _refusal(bench, one["hide"])):
        return
    for p in one["parameters"]:
        usual = re.sub(rf"\b{p['name']}=[^,]*", f"{p['name']}={p['usual']}", one["hide"])
        p["wrong"] = wrong if _refusal(bench, usual) != wrong else ""


def _refusal(bench: Mapping[str, str], hide: str) -> str:
    """Return why an effect alone is refused; "" if it is not."""
    try:
        _prepare(bench, [hide])
    except ConfigError as error:
        return str(error).removeprefix(f"--hide {hide}: ")
    return ""


def draw_effect(bench: Mapping[str, str], hide: str, *, progress: Progress) -> str:
    """Return a picture that compares a run with an effect and a run without it."""
    from pipeline.report.builder import PageBuilder
    from pipeline.report.effects import effect_picture
    from pipeline.report.figures.style import drawing

    hidden = _prepare(bench, [hide])
    with drawing():
        picture = effect_picture(PageBuilder(), hidden.effects[-1], hidden.chain, bench=hidden.name)
    return picture.svg


def make_exercises(
    bench: Mapping[str, str],
    hide: Sequence[str],
    out: str,
    seeds: Sequence[int],
    reported: bool,
    vary: float,
    *,
    progress: Progress,
) -> list[str]:
    """Write an exercise for each seed; return the folders.

    With one seed the exercise is in `out`; with several, each is in a subfolder of `out`.

    Parameters
    ----------
    vary : by how many percent the bench of each exercise may differ; the true values are then in
        `key_of(out)`.
    """
    from pipeline.grading.true_bench import write_team
    from pipeline.simulated.submission import write_submission

    hidden, root = _prepare(bench, hide), new_folder(Path(out))
    count = len(seeds)
    made = [root / f"{i + 1:0{len(str(count))}d}" for i in range(count)] if count > 1 else [root]
    for i, (folder, seed) in enumerate(zip(made, seeds, strict=True)):
        progress(f"exercise {i + 1} of {count}")
        if vary:
            write_team(
                folder, lambda _: hidden, percent=vary, key=key_of(root), seed=seed,
                reported=reported, progress=progress,
            )  # fmt: skip
        else:
            write_submission(folder, hidden, seed=seed, reported=reported)
    return [str(folder) for folder in made]


def key_of(out: Path) -> Path:
    """Return the path of the answer key of exercises: beside them, where no student gets it."""
    return out.with_name(f"{out.name}-key.json")


def describe_hidden(bench: Mapping[str, str], hide: Sequence[str]) -> list[str]:
    """Return what is hidden in a bench, one sentence for each effect."""
    return list(_prepare(bench, hide).effect_sentences)


def make_solution(folder: str, *, progress: Progress) -> None:
    """Write the reference solution of a submission into its folder."""
    from pipeline.report.solution.write import make_solution as write_solution

    submission = load_submission(Path(folder))
    write_solution(submission, own_folder(submission.folder, "solution"), progress=progress)


def _prepare(bench: Mapping[str, str], hide: Sequence[str] = ()) -> SimulatedBench:
    if preset := bench.get("preset"):
        return prepare_bench(preset=preset, hide=hide)
    chain = {name: _read_numbers(name, bench.get(name, "")) for name in ("m", "c", "k")}
    with TemporaryDirectory() as folder:
        path = Path(folder) / _OWN
        path.write_text(json.dumps({"chain": chain}), encoding="utf-8")
        try:
            return prepare_bench(model=path, hide=hide)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"--model {path}", _OWN)) from None


def _read_numbers(name: str, typed: str) -> list[float]:
    try:
        return [float(text) for text in re.split(r"[\s,;]+", typed.strip()) if text]
    except ValueError:
        raise ConfigError(f"{_OWN}: {name} needs numbers with blanks between them") from None


def _describe_effect(bench: SimulatedBench, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return an effect for the form; parameters not typed get values that show the effect."""
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
        _describe_parameter(p, sizes[p.name], entry["sizes"].get(p.name, {}), bench)
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


def _describe_parameter(
    parameter: EffectParameter, usual: float, typed: Mapping[str, str], bench: SimulatedBench
) -> dict[str, Any]:
    """Return one parameter for the form; its slider and its number agree.

    If the slider was moved, it sets the value. Otherwise the typed number is used, or the usual
    value if nothing was typed.
    """
    none = parameter.neutral or 0.0
    value = typed.get("value", "") if typed.get("value") != typed.get("usual") else ""
    value = value.replace(",", ".")  # a comma separates the parameters
    if typed.get("slide", "") != typed.get("was", ""):
        slide = _read_number(typed.get("slide", "")) or 0.0
        value = f"{none + (usual - none) * 10 ** max(-SLIDE, min(SLIDE, slide)):.3g}"
    value = value or f"{usual:.3g}"
    times = ((_read_number(value) or none) - none) / (usual - none)
    slide = max(-SLIDE, min(SLIDE, math.log10(times))) if times > 0 else 0.0
    return {
        "name": parameter.name,
        "symbol": parameter.symbol,
        "unit": parameter.unit_text(position=bench.position_unit, input=bench.input_unit),
        "value": value,
        "usual": f"{usual:.3g}",
        "slide": f"{round(slide, 2) + 0.0:g}",
        "wrong": "",
    }


def _read_number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
