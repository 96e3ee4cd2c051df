"""The gap in words: what explains it, how well, and what to do next."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.advice import disputed
from pipeline.gap.limits import AS_REPEATS, AT_FLOOR, NO_MODEL, NOTHING
from pipeline.gap.types import FoundEffect, Gap, NamedValue, RecordGap
from pipeline.plant.effect import Effect, effect_name
from pipeline.report.document import Block, Tile, Tiles, Tone, bullet_list, paragraph, plain_lines
from pipeline.words.numbers import count, listing, significant, unit_text, with_error
from pipeline.words.phrases import phrases
from pipeline.words.text import Spans, capital, clean, rich, spans

WORDS = phrases("gap")


def added_name(gap: Gap) -> str:
    """Return the name of the model with effects; "" if it has no effects."""
    if not gap.effects:
        return ""
    return WORDS.text("with_suspects" if gap.verdict == "unexplained" else "with_effects")


def whole_model(gap: Gap) -> str:
    """Return the final model's name inside a sentence, such as "the model with its effects"."""
    return WORDS.text("model_suspects" if gap.verdict == "unexplained" else "model_effects")


def verdict_title(gap: Gap) -> str:
    """Return the verdict in a few words; a set-up in doubt comes before any other cause."""
    if gap.causes and gap.verdict != "none":
        return WORDS.text("title_causes")
    if gap.verdict == "unexplained":
        return WORDS.text(f"title_{_of_unexplained(gap)}")
    return WORDS.text(f"title_{gap.verdict}")


def _of_unexplained(gap: Gap) -> str:
    """Return which phrase tells why a gap is unexplained."""
    if not gap.complete:
        return "undecided"
    taught = [row.baseline for row in gap.by_record if not row.held_out]
    fails = gap.baseline > NO_MODEL and max(taught, default=0.0) > NO_MODEL
    return "no_model" if fails else "unexplained"


def is_set_up_alone(gap: Gap) -> bool:
    """Return whether only the set-up is in doubt, and no effect is suspected."""
    return bool(gap.causes) and not (gap.effects or gap.suspects)


def error_board(gap: Gap) -> Tiles:
    """Return the errors on held-out runs: before, after, and from noise alone.

    The final model's tile has the colour of the verdict, or no colour if two explanations are
    possible.
    """
    tones: dict[str, Tone] = {"none": "good", "named": "good", "ambiguous": ""}
    tiles = [_tile("linear", gap.baseline)]
    if gap.effects:
        what = "suspect" if gap.verdict == "unexplained" else "effect"
        tiles.append(_tile("effects", gap.final, effects=count(len(gap.effects), what)))
    tiles[-1] = replace(tiles[-1], tone=tones.get(gap.verdict, "bad"))
    tiles.append(_tile("noise", gap.noise_floor))
    if gap.repeatability is not None:
        tiles.append(_tile("repeats", gap.repeatability))
    return Tiles(tuple(tiles))


def _tile(key: str, error: float, **values: str) -> Tile:
    label, note = WORDS.spans(f"tile_{key}", **values), WORDS.spans(f"tile_{key}_note")
    return Tile(label, spans(share(error)), note)


def verdict_blocks(gap: Gap) -> list[Block]:
    """Return what explains the gap and how well; for `ambiguous`, both explanations.

    Doubts about the set-up come first, because a wrong set-up looks like missing physics.
    """
    causes: list[Block] = []
    if gap.causes:
        told = " ".join(dict.fromkeys(clean(check.message) for check in gap.causes))
        key = "causes_none" if gap.verdict == "none" else "causes"
        causes = [paragraph(WORDS.spans(key, messages=rich(told)))]
    so_far = [] if gap.complete else [paragraph(WORDS.spans("so_far"))]
    match gap.verdict:
        case "none":
            blocks: list[Block] = [
                paragraph(WORDS.spans("none", noise=_noise(gap), baseline=share(gap.baseline)))
            ]
        case "named" | "partial":
            blocks = _named(gap)
        case "ambiguous":
            blocks = _ambiguous(gap)
        case "unexplained":
            blocks = [_unexplained(gap)]
    return [*causes, *so_far, *blocks]


def scope_blocks(gap: Gap, *, position: str, drive: str) -> list[Block]:
    """Return what a sufficient linear model covers, and how large a hidden effect could be."""
    repeats = AS_REPEATS * (gap.repeatability or 0.0)
    noise = float(np.sqrt(AT_FLOOR)) * gap.noise_floor
    # The search for effects begins only when the error exceeds both limits, and may find nothing
    # that lowers it. Errors of noise and of a hidden effect add as squares.
    hidden = float(np.sqrt(max(noise, repeats, gap.baseline) ** 2 - gap.noise_floor**2))
    lost = WORDS.text("lost_in_repeats" if repeats > noise else "lost_in_noise")
    blocks: list[Block] = [
        paragraph(WORDS.spans("none_hidden", share=share(hidden), lost=lost)),
    ]
    reach: dict[int, float] = {}
    for trace in gap.traces:
        far = float(np.max(np.abs(trace.measured - trace.zero)))
        reach[trace.cart] = max(far, reach.get(trace.cart, 0.0))
    if not reach:  # unknown if the analysis was read from a file
        return blocks
    said = [
        f"cart {cart} up to {significant(far, digits=3)} {position}"
        for cart, far in sorted(reach.items())
    ]
    driven = max(float(np.max(np.abs(trace.u))) for trace in gap.traces)
    if driven > 0:
        said.append(f"the input up to {significant(driven, digits=3)} {drive}")
    return [paragraph(WORDS.spans("none_reach", reach=listing(said))), *blocks]


def next_block(gap: Gap) -> list[Block]:
    """Return the next recording to make."""
    if gap.next_experiment:
        key = f"next_{gap.advice.aim}" if gap.advice else "next_explain"
        return [paragraph(WORDS.spans(key, experiment=clean(gap.next_experiment)))]
    return [paragraph(WORDS.spans("next_none"))] if gap.verdict == "none" else []


def terminal_verdict(gap: Gap) -> str:
    """Return the verdict as a few lines of text."""
    return plain_lines([paragraph(verdict_title(gap)), *verdict_blocks(gap), *next_block(gap)])


# ------------------------------------------------------------------- the verdicts


def _named(gap: Gap) -> list[Block]:
    """Return which effects explain the gap, and each effect with its sizes in its own sentence."""
    names = [found.name for found in gap.effects]
    what = "part of what" if gap.verdict == "partial" else "what"
    said = {"names": capital(listing(names)), "what": what, "errors": _errors(gap)}
    if len(names) == 1:
        (found,) = gap.effects
        sizes, sentence = sizes_text(found.parameters), found.effect.sentence
        return [paragraph(WORDS.spans("named", sizes=sizes, sentence=sentence, **said))]
    effects, seen = [], set[str]()
    for found in gap.effects:
        sentence = "" if found.effect.key in seen else f" {found.effect.sentence}"
        seen.add(found.effect.key)
        sizes = sizes_text(found.parameters)
        effects.append(
            WORDS.spans("named_effect", Name=capital(found.name), sizes=sizes, sentence=sentence)
        )
    return [paragraph(WORDS.spans("named_together", **said)), bullet_list(effects)]


def _ambiguous(gap: Gap) -> list[Block]:
    last, rival = disputed(gap)
    others = [effect_name(f.effect, f.where) for f in gap.effects if f is not last]
    values = {
        "name": capital(effect_name(last.effect, last.where)),
        "beside": f", beside {listing(others)}" if others else "",
        "errors": _errors(gap),
    }
    both = [_explanation(last.effect, last.where, gap.final, sizes_text(last.parameters))]
    if rival is None:
        return [paragraph(WORDS.spans("ambiguous_alone", **values)), bullet_list(both)]
    both.append(_explanation(rival.effect, rival.where, rival.nrmse_after, ""))
    named = effect_name(rival.effect, rival.where)
    return [paragraph(WORDS.spans("ambiguous", rival=named, **values)), bullet_list(both)]


def _explanation(effect: Effect, where: Mapping[str, int], error: float, sizes: str) -> Spans:
    return WORDS.spans(
        "explanation",
        name=capital(effect_name(effect, where)),
        values=f" ({sizes})" if sizes else "",
        error=share(error),
        sentence=effect.sentence,
        fingerprint=effect.fingerprint,
    )


def _unexplained(gap: Gap) -> Block:
    values = {"noise": _noise(gap), "suspicion": _suspicion(gap), **shares(gap)}
    if is_set_up_alone(gap):
        return paragraph(WORDS.spans("unsuspected", **values))
    if not gap.effects:
        key = _of_unexplained(gap)
        if gap.final < NOTHING * gap.noise_floor and key != "no_model":
            key = f"{key}_taught"
        return paragraph(WORDS.spans(key, **values))
    suspects = listing([effect_name(found.effect, found.where) for found in gap.effects])
    are = "suspect is" if len(gap.effects) == 1 else "suspects, together, are"
    key = "suspected" if gap.complete else "suspected_so_far"
    return paragraph(WORDS.spans(key, are=are, suspects=suspects, **values))


def _suspicion(gap: Gap) -> str:
    """Return which other effects are suspected, as a further sentence."""
    if not gap.suspects:
        return ""
    named = [
        f"{effect_name(s.effect, s.where)} (leaves an error of {share(s.nrmse_after)})"
        for s in gap.suspects
    ]
    also = "Also suspected" if gap.effects else "Suspected, though not proven"
    return f" {also}: {listing(named)}."


def shares(gap: Gap | RecordGap) -> dict[str, str]:
    """Return the errors before and after, and the noise, as text, for all runs or for one."""
    errors = {"baseline": gap.baseline, "final": gap.final, "noise_floor": gap.noise_floor}
    return {name: share(error) for name, error in errors.items()}


def _noise(gap: Gap) -> str:
    """Return the error that no model can undercut, as a clause."""
    if gap.repeatability is not None and gap.repeatability >= gap.noise_floor:
        return WORDS.text("repeats_differ", share=share(gap.repeatability))
    return WORDS.text("noise_makes", share=share(gap.noise_floor))


def _errors(gap: Gap) -> str:
    errors = WORDS.text("errors", noise=_noise(gap), **shares(gap))
    least = max(gap.noise_floor, gap.repeatability or 0.0)
    if not gap.left or gap.final <= NOTHING * least:
        return errors
    worst, times = gap.left[0], "More remains"
    if least:
        times = f"The error is still {significant(gap.final / least, digits=2)} times that"
    return WORDS.text(
        "left",
        errors=errors,
        times=times,
        run=clean(worst.experiment),
        cart=worst.cart,
        start=f"{worst.start:.2f}",
        end=f"{worst.end:.2f}",
        what=phase(worst.what),
    )


def kept_together(effects: Sequence[FoundEffect]) -> list[tuple[FoundEffect, ...]]:
    """Return the effects in groups, each of which lowers the held-out error; the order is kept.

    A group has several effects if they lower the error only together.
    """
    groups: list[tuple[FoundEffect, ...]] = []
    group: tuple[FoundEffect, ...] = ()
    for found in effects:
        group = (*group, found)
        if found.nrmse_after < group[0].nrmse_before:
            groups.append(group)
            group = ()
    return [*groups, group] if group else groups


# ----------------------------------------------------------------------- phrases


def sizes_text(parameters: Mapping[str, NamedValue]) -> str:
    """Return sizes inside a sentence: "force 0.41 ± 0.01 V, distance 0.02 ± 0.01 cm"."""
    return ", ".join(
        f"{name.replace('_', ' ')} {_size(value)}" for name, value in parameters.items()
    )


def _size(value: NamedValue) -> str:
    unit = unit_text(clean(value.unit))
    # The text leaves out a very small standard error, which is in the table.
    exact = value.std is not None and value.std < 1e-3 * abs(value.value)
    text = significant(value.value) if exact else with_error(value.value, value.std)
    return text + (f" {unit}" if unit else "")


def phase(what: str) -> str:
    """Return the name of a kind of motion as text, such as "velocity near zero"."""
    return WORDS.text("throughout") if what == "throughout" else clean(what)


def share(value: float) -> str:
    """Return a share of the motion in percent, with two digits, or three from 10 % on."""
    digits = 3 if value >= 0.0995 else 2
    return f"{significant(100 * value, digits=digits)} %"
