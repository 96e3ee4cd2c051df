"""Hidden effects of a bench: named by the user, or taken from the model of a `gap.json`."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import ConfigError
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.effect import Effect, EffectParameter, EffectTerm, PlaceScales, chain_scales
from pipeline.plant.simulate import simulate_linear
from pipeline.simulated.bench import COUNT, SAMPLE_TIME, SimulatedBench
from pipeline.submission.toml import nearest, quote, read_text

_PER_CM = {"cm": 1.0, "mm": 10.0, "m": 0.01, "in": 1 / 2.54, "count": 1 / COUNT}
_SLOWEST, _FASTEST = 0.01, 1e4  # rad/s: periods from ten minutes to far below any sample time
# Beyond any physical number in any unit, yet safe to multiply.
_SMALLEST, _LARGEST = 1e-30, 1e30
_INPUT_RESERVE = 4.0  # multiple of the input that holds a cart at its travel


def prepare_bench(
    *,
    preset: str | None = None,
    model: Path | None = None,
    hide: Sequence[str] = (),
    rng: np.random.Generator | None = None,
) -> SimulatedBench:
    """Return a preset, or the model of a `gap.json`, with further effects hidden in it.

    Parameters
    ----------
    hide : effects to hide, each as `EFFECT` or `EFFECT:key=value,…`. The keys are `cart` or
        `spring` and the parameters of the law. Omitted parameters get a clearly visible size.
    rng : random numbers that draw one of the alternatives of a text `EFFECT/EFFECT/…`; None if
        there may be no alternatives.

    Raises
    ------
    ConfigError : neither or both of `preset` and `model` are given, or a given value is wrong.
    """
    if (preset is None) == (model is None):
        raise ConfigError("name a bench: either --preset or --model")
    bench = _read_model(model) if model is not None else preset_bench(preset or "")
    for text in hide:
        option = _choose(text, bench, rng)
        term, given = _named_effect(option, bench)
        bench = _with_effect(bench, term, where=f"--hide {option}", given=given)
    return bench


def _choose(text: str, bench: SimulatedBench, rng: np.random.Generator | None) -> str:
    """Return an alternative of `EFFECT/EFFECT/…` that is unlike all effects of the bench."""
    options = text.split("/")
    if len(options) == 1:
        return text
    if rng is None:
        raise ConfigError(
            f"--hide {text}: only `simulate --vary … --secret …` draws one of several effects"
        )
    terms = [_named_effect(option, bench)[0] for option in options]
    unlike = [
        option
        for option, term in zip(options, terms, strict=True)
        if not any(_is_related(term, other) for other in bench.effects)
    ]
    if not unlike:
        raise ConfigError(f"--hide {text}: the bench already has effects like all of these")
    return unlike[rng.integers(len(unlike))]


def _with_effect(
    bench: SimulatedBench, term: EffectTerm, *, where: str, given: frozenset[str] | None = None
) -> SimulatedBench:
    """Return the bench with one more effect, which must not be there already."""
    _refuse_second(term, bench.effects, where=where)
    sentences = (*bench.effect_sentences, _describe(term, bench, given=given))
    return replace(bench, effects=(*bench.effects, term), effect_sentences=sentences)


def preset_bench(name: str) -> SimulatedBench:
    """Return a preset by its name.

    Raises
    ------
    ConfigError : there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}: there are {', '.join(PRESETS)}")
    return SimulatedBench(chain=PRESETS[name], name=name)


def usual_term(effect: Effect, chain: Chain, *, travel: float = 1.0) -> EffectTerm:
    """Return the effect at its usual place, at a clearly visible size."""
    place = _place(effect, chain, None, where=effect.key)
    return _term(effect, place, default_values(effect, chain, place=place, travel=travel))


def default_values(effect: Effect, chain: Chain, *, place: int, travel: float) -> dict[str, float]:
    """Return sizes at which the effect is clearly visible in a session."""
    scales, side = _session_scales(effect, chain, place=place, travel=travel)
    return {
        p.name: float(f"{p.size(scales) * p.typical:.3g}") * (side if p.side else 1.0)
        for p in effect.parameters
    }


# ---------------------------------------------------------------- named by the user


def _named_effect(text: str, bench: SimulatedBench) -> tuple[EffectTerm, frozenset[str]]:
    """Return the effect of one `--hide`, and the names of the parameters that the text gives."""
    where = f"--hide {text}"
    key, _, assignments = text.partition(":")
    effect = _effect(key.strip(), where=where)
    places = () if effect.place == "input" else (effect.place,)
    given: dict[str, float] = {}
    for assignment in filter(None, (part.strip() for part in assignments.split(","))):
        name, equals, value = (part.strip() for part in assignment.partition("="))
        if name not in (*places, *effect.names):
            known = nearest(name, [*places, *effect.names])
            raise ConfigError(f"{where}: {effect.key} has no {name!r}{known}")
        if name in given:
            raise ConfigError(f"{where}: {name} is given twice")
        if not equals:
            raise ConfigError(f"{where}: write {name}=VALUE")
        given[name] = _number(value, where=f"{where}: {name}")
    place = _place(effect, bench.chain, given.pop(effect.place, None), where=where)
    scales, _ = _session_scales(effect, bench.chain, place=place, travel=bench.travel)
    for parameter in effect.parameters:
        if parameter.name in given:
            _refuse_impossible(parameter, given[parameter.name], scales, where=where)
    values = default_values(effect, bench.chain, place=place, travel=bench.travel) | given
    _refuse_weak_hold(effect, values, where=where)
    return _term(effect, place, values), frozenset(given)


def _effect(key: str, *, where: str) -> Effect:
    try:
        return find_effect(key)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _number(text: str, *, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{where} needs a number, found {quote(text)}")
    if value and not _SMALLEST <= abs(value) <= _LARGEST:
        raise ConfigError(
            f"{where}: expected 0 or a size of {_SMALLEST:g} to {_LARGEST:g}, found {value:g}"
        )
    return value


def _term(effect: Effect, place: int, values: Mapping[str, float]) -> EffectTerm:
    return EffectTerm(
        effect=effect, place=place, values=tuple(values[name] for name in effect.names)
    )


def _place(effect: Effect, chain: Chain, at: float | None, *, where: str) -> int:
    """Return the given cart or spring, or the usual one: cart 1, spring 2, or the only one.

    Any existing place is accepted, even if no data could show the effect there.
    """
    if effect.place == "input":
        return 0
    if effect.place == "cart":
        places = list(range(1, chain.n + 1))
    else:
        places = [j for j, k in enumerate(chain.k, start=1) if k > 0]
    if at is None:
        usual = 2 if effect.place == "spring" else 1
        return usual if usual in places else places[0]
    if at not in places:
        there = ", ".join(map(str, places))
        raise ConfigError(
            f"{where}: no {effect.place} {at:g} on this bench; there is {effect.place} {there}"
        )
    return int(at)


def _refuse_impossible(
    parameter: EffectParameter, value: float, scales: PlaceScales, *, where: str
) -> None:
    """Refuse a size that has no meaning in the law."""
    if parameter.signed or parameter.side:
        return
    lower = parameter.lower * parameter.size(scales)
    if value < lower or (value == 0.0 and parameter.neutral != 0.0):
        least = f"at least {lower:.3g}" if lower or parameter.neutral == 0.0 else "positive"
        raise ConfigError(f"{where}: {parameter.name} must be {least}")


def _refuse_weak_hold(effect: Effect, values: Mapping[str, float], *, where: str) -> None:
    """Refuse friction that is smaller at rest than in motion."""
    held, sliding = values.get("static_force"), values.get("force")
    if held is not None and sliding is not None and held < sliding:
        raise ConfigError(
            f"{where}: {effect.key} holds with static_force {held:g}, which is below the sliding "
            f"force {sliding:g}"
        )


def _refuse_second(term: EffectTerm, present: Sequence[EffectTerm], *, where: str) -> None:
    """Refuse an effect if it, or another of its family, is already hidden at the same place."""
    for other in present:
        if other.place == term.place and _is_related(term, other):
            raise ConfigError(
                f"{where}: {_at(other) or 'the input'} already has {other.effect.key}"
            )


def _is_related(term: EffectTerm, other: EffectTerm) -> bool:
    """Return whether two effects are the same, or of one family."""
    family = term.effect.family
    return other.effect is term.effect or bool(family and other.effect.family == family)


def _session_scales(
    effect: Effect, chain: Chain, *, place: int, travel: float
) -> tuple[PlaceScales, float]:
    """Return typical sizes of motion at a place, and on which side the larger step moves it.

    The sizes are those in the larger step. But a spring is stretched by the travel or more,
    because carts are also released by hand.
    """
    # The step goes to 0.9 of the travel, like the larger steps of a session.
    u = 0.9 * travel / float(np.max(np.abs(chain.static_gains())))
    slowest = float(np.abs(chain.poles).min())
    # Six periods of the slowest motion are enough, as the first swings are the largest.
    t = SAMPLE_TIME * np.arange(max(2.0, 6.0 * 2 * np.pi / (slowest * SAMPLE_TIME)))
    # The larger step of a session goes to the negative side.
    x = simulate_linear(chain, t, np.full(t.size, -u))
    if effect.place == "spring":
        walls = np.zeros((1, t.size))
        x = np.diff(np.concatenate([walls, x, walls]), axis=0)
    least = travel if effect.place == "spring" else 0.0
    extreme = x[np.arange(x.shape[0]), np.argmax(np.abs(x), axis=1)]
    scales = chain_scales(
        chain,
        place=effect.place,
        at=place,
        largest=(
            np.maximum(np.abs(extreme), least),
            np.max(np.abs(np.diff(x, axis=1)), axis=1) / SAMPLE_TIME,
        ),
        input=u,
        sample_time=SAMPLE_TIME,
    )
    return scales, float(np.sign(extreme[max(place - 1, 0)]))


def _at(term: EffectTerm) -> str:
    return f"{term.effect.place} {term.place}" if term.place else ""


def _describe(
    term: EffectTerm, bench: SimulatedBench, *, given: frozenset[str] | None = None
) -> str:
    """Return a sentence on the effect, with its place and parameters."""
    sizes = []
    for parameter, value in zip(term.effect.parameters, term.values, strict=True):
        unit = parameter.unit_text(position=bench.position_unit, input=bench.input_unit)
        note = "" if given is None or parameter.name in given else "(default)"
        sizes.append(" ".join(filter(None, [parameter.name, f"{value:.4g}", unit, note])))
    place = f" on {_at(term)}" if term.place else ""
    clear = term.effect.places(tuple(bool(k > 0) for k in bench.chain.k))
    doubt = "; here the linear chain can do the same" if term.place not in clear else ""
    return f"{term.effect.key}{place}: {', '.join(sizes)}{doubt}"


# ---------------------------------------------------------------- read from a file


def _read_model(path: Path) -> SimulatedBench:
    """Read the model of a `gap.json`: a chain, and the effects that act on it."""
    where = f"--model {path}"
    try:
        document = json.loads(read_text(path, where=where, limit=10_000_000, error=ConfigError))
    except json.JSONDecodeError as error:
        raise ConfigError(
            f"{where}: not valid JSON from line {error.lineno}, character {error.colno}: give a "
            "complete gap.json, as `cartlab gap` writes it"
        ) from None
    except (RecursionError, ValueError):
        raise ConfigError(f"{where}: not the JSON of a gap.json") from None
    document = _mapping(document, where=where)
    model = _mapping(document.get("model", document), where=f"{where}: model")
    chain = _chain(model.get("chain"), where=f"{where}: chain")
    units = _mapping(document.get("units", {}), where=f"{where}: units")
    position, drive = str(units.get("position", "cm")), str(units.get("input", "V"))
    per_cm = _PER_CM.get(position, 1.0)
    hold = per_cm / float(np.max(np.abs(chain.static_gains())))
    bench = SimulatedBench(
        chain=chain,
        name=path.name,
        position_unit=position,
        input_unit=drive,
        travel=per_cm,
        count=COUNT * per_cm,
        input_limit=max(5.0, float(f"{_INPUT_RESERVE * hold:.2g}")),  # input units
    )
    effects = model.get("effects", [])
    if not isinstance(effects, list):
        raise ConfigError(f"{where}: effects must be a list")
    for number, entry in enumerate(effects, start=1):
        place = f"{where}: effects[{number}]"
        bench = _with_effect(bench, _stored_effect(entry, bench, where=place), where=place)
    return bench


def _chain(entry: object, *, where: str) -> Chain:
    fields = _mapping(entry, where=where)
    try:
        chain = Chain(m=fields["m"], c=fields["c"], k=fields["k"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"needs {error}" if isinstance(error, KeyError) else str(error)[:200]
        raise ConfigError(f"{where}: {reason}") from None
    numbers = np.concatenate([chain.m, chain.c, chain.k])
    if not (np.all(np.isfinite(numbers)) and np.all(chain.m > 0) and np.all(numbers >= 0)):
        raise ConfigError(f"{where}: m must be positive, c and k at least zero")
    sizes = numbers[numbers > 0]
    if sizes.min() < _SMALLEST or sizes.max() > _LARGEST:
        raise ConfigError(
            f"{where}: expected sizes of {_SMALLEST:g} to {_LARGEST:g}, found {sizes.min():.3g} to "
            f"{sizes.max():.3g}"
        )
    motions = np.abs(chain.poles)
    if not _SLOWEST <= motions.min() <= motions.max() <= _FASTEST:
        raise ConfigError(
            f"{where}: its frequencies are {motions.min():.3g} to {motions.max():.3g} rad/s; "
            f"expected {_SLOWEST:g} to {_FASTEST:g} rad/s, as on a bench"
        )
    return chain


def _stored_effect(entry: object, bench: SimulatedBench, *, where: str) -> EffectTerm:
    """Return one effect; parameter values are numbers, or objects with a `value`.

    Details of a contact that are not in the file get their usual size.
    """
    fields = _mapping(entry, where=where)
    effect = _effect(str(fields.get("effect")), where=where)
    stored = _mapping(fields.get("parameters"), where=f"{where}.parameters")
    stored = {**stored, **_mapping(fields.get("details", {}), where=f"{where}.details")}
    values: dict[str, float] = {}
    for name, value in stored.items():
        number = value.get("value") if isinstance(value, dict) else value
        values[name] = _number(str(number), where=f"{where}.parameters.{name}")
    if unknown := [name for name in values if name not in effect.names]:
        known = nearest(unknown[0], effect.names)
        raise ConfigError(f"{where}: {effect.key} has no {quote(unknown[0])}{known}")
    if missing := [p.name for p in effect.parameters if p.reported and p.name not in values]:
        raise ConfigError(f"{where}: {effect.key} needs {missing[0]}")
    at = _mapping(fields.get("where", {}), where=f"{where}.where").get(effect.place, 0)
    place = _place(effect, bench.chain, _number(str(at), where=f"{where}.where"), where=where)
    usual = default_values(effect, bench.chain, place=place, travel=bench.travel)
    for parameter in effect.parameters:  # those not in the file are not refused
        size = values.get(parameter.name, 1.0)
        unsigned = not (parameter.signed or parameter.side)
        if unsigned and (size < 0.0 or (size == 0.0 and parameter.lower > 0.0)):
            raise ConfigError(f"{where}: {parameter.name} must be positive, found {size:g}")
    return _term(effect, place, usual | values)


def _mapping(value: object, *, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: missing, or no JSON object")
    return value
