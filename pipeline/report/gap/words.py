"""The gap in plain words: what explains it, how well, and what to do next."""

from collections.abc import Mapping

from pipeline.gap.types import FoundEffect, Gap, NamedValue, Rival
from pipeline.plant.effects.base import Effect
from pipeline.report.document import (
    Block,
    Span,
    Spans,
    Tile,
    Tiles,
    bullet_list,
    paragraph,
    spans,
)
from pipeline.report.numbers import count, listing, significant, unit_text, with_error
from pipeline.report.words import clean, plain_lines

_AS_GOOD = 1.15  # times the error: a rival that the data do not tell from what was chosen
_NEGLIGIBLE = 1e-3  # of a value: an error this small stands in the table alone


def verdict_title(gap: Gap) -> str:
    """Return the verdict in a few words."""
    return {
        "none": "The linear model is enough",
        "named": "The gap has a name",
        "partial": "Part of the gap has a name",
        "ambiguous": "Two explanations fit alike",
        "unexplained": "A gap that nothing in the catalogue explains",
    }[gap.verdict]


def error_board(gap: Gap) -> Tiles:
    """Return the error on runs no fit has seen: before, after, and what noise alone makes."""
    effects = count(len(gap.effects), "effect") if gap.effects else "no effect"
    tiles = [
        Tile(spans("Linear model"), spans(share(gap.baseline)), spans("of the motion is left")),
        Tile(
            spans(f"With {effects}"),
            spans(share(gap.final)),
            spans("is left"),
            "good" if gap.verdict in ("none", "named") else "bad",
        ),
        Tile(spans("Noise alone"), spans(share(gap.noise_floor)), spans("cannot be explained")),
    ]
    if gap.repeatability is not None:
        tiles.append(
            Tile(
                spans("Repeats differ by"), spans(share(gap.repeatability)), spans("of the motion")
            )
        )
    return Tiles(tuple(tiles))


def verdict_blocks(gap: Gap) -> list[Block]:
    """Say what explains the gap and how well; under `ambiguous`, both explanations."""
    return [*_so_far(gap), *_verdict(gap)]


def _so_far(gap: Gap) -> list[Block]:
    if gap.complete:
        return []
    return [
        paragraph(
            Span("The best answer so far. ", "strong"),
            "The time allowed ended the search before every explanation was tried: more time "
            "(the option ",
            Span("--budget", "code"),
            ") may find a better one, and a faster computer may come further in the same time.",
        )
    ]


def _verdict(gap: Gap) -> list[Block]:
    match gap.verdict:
        case "none":
            return [
                paragraph(
                    Span("The linear model explains the data. ", "strong"),
                    f"On runs it had not seen it is off by {share(gap.baseline)} of the motion; "
                    f"noise alone makes {share(gap.noise_floor)}. No effect is needed.",
                )
            ]
        case "named" | "partial":
            return [_named(gap)]
        case "ambiguous":
            return _ambiguous(gap)
        case "unexplained":
            return [_unexplained(gap)]


def next_block(gap: Gap) -> list[Block]:
    """Say which experiment comes next, nothing where none is needed."""
    if not gap.next_experiment:
        return []
    lead = {
        "named": "The experiment that would confirm it. ",
        "ambiguous": "What would tell them apart. ",
    }.get(gap.verdict, "What to measure next. ")
    return [paragraph(Span(lead, "strong"), clean(gap.next_experiment))]


def terminal_verdict(gap: Gap) -> str:
    """Return the verdict as a few lines of plain text."""
    return plain_lines([paragraph(verdict_title(gap)), *verdict_blocks(gap), *next_block(gap)])


# ------------------------------------------------------------------- the verdicts


def _named(gap: Gap) -> Block:
    names = [effect_name(found.effect, found.where) for found in gap.effects]
    sizes = "; ".join(sizes_text(found.parameters) for found in gap.effects)
    verb = "explains" if len(names) == 1 else "together explain"
    what = "part of what" if gap.verdict == "partial" else "what"
    return paragraph(
        Span(f"{_capital(listing(names))} {verb} {what} the linear model leaves out: ", "strong"),
        f"{sizes}. {' '.join(found.effect.sentence for found in gap.effects)} ",
        _errors(gap),
    )


def _ambiguous(gap: Gap) -> list[Block]:
    last, rival = contenders(gap)
    others = [effect_name(f.effect, f.where) for f in gap.effects if f is not last]
    beside = f", beside {listing(others)}" if others else ""
    return [
        paragraph(
            Span(
                f"{_capital(effect_name(last.effect, last.where))}, or "
                f"{effect_name(rival.effect, rival.where)}{beside}: "
                "these data cannot tell which. ",
                "strong",
            )
            if rival
            else Span(
                f"{_capital(effect_name(last.effect, last.where))}{beside}, "
                "or another effect that these data cannot tell from it. ",
                "strong",
            ),
            _errors(gap),
        ),
        bullet_list(
            [
                _explanation(last.effect, last.where, gap.final, sizes_text(last.parameters)),
                *(
                    [_explanation(rival.effect, rival.where, rival.nrmse_after, "")]
                    if rival
                    else []
                ),
            ]
        ),
    ]


def _explanation(effect: Effect, where: Mapping[str, int], error: float, sizes: str) -> Spans:
    values = f" ({sizes})" if sizes else ""
    return spans(
        Span(_capital(effect_name(effect, where)), "strong"),
        f"{values}: leaves {share(error)} of the motion. {effect.sentence} {effect.fingerprint}",
    )


def _unexplained(gap: Gap) -> Block:
    if not gap.effects:
        return paragraph(
            Span("Something is missing, and nothing in the catalogue explains it. ", "strong"),
            f"On runs it had not seen the linear model is off by {share(gap.baseline)} of the "
            f"motion; {_noise(gap)}. No effect shrinks that enough to be believed."
            + _suspicion(gap),
        )
    suspects = listing([effect_name(found.effect, found.where) for found in gap.effects])
    are = "suspect is" if len(gap.effects) == 1 else "suspects, together, are"
    return paragraph(
        Span("Something is missing that nothing in the catalogue explains. ", "strong"),
        f"The best {are} {suspects}. The error on runs the model had not seen then falls from "
        f"{share(gap.baseline)} of the motion to {share(gap.final)}, but {_noise(gap)}. "
        f"Too much is left for a name.{_suspicion(gap)}",
    )


def _suspicion(gap: Gap) -> str:
    """Return who else is suspected, as a further sentence."""
    if not gap.suspects:
        return ""
    named = [
        f"{effect_name(s.effect, s.where)} (leaves {share(s.nrmse_after)})" for s in gap.suspects
    ]
    also = "Also suspected" if gap.effects else "Suspected, though not proven"
    return f" {also}: {listing(named)}."


def _noise(gap: Gap) -> str:
    """Return what no model can be better than, as a clause."""
    if gap.repeatability is not None and gap.repeatability >= gap.noise_floor:
        return f"repeats of one run differ by {share(gap.repeatability)}"
    return f"noise alone makes {share(gap.noise_floor)}"


def _errors(gap: Gap) -> str:
    text = (
        "On runs the model had not seen the error falls from "
        f"{share(gap.baseline)} of the motion to {share(gap.final)}; {_noise(gap)}."
    )
    if not gap.left:
        return text
    least = max(gap.noise_floor, gap.repeatability or 0.0)
    worst = gap.left[0]
    times = f"So {significant(gap.final / least, digits=2)} times as much" if least else "More"
    return (
        f"{text} {times} is left, most of it in {clean(worst.experiment)}, cart {worst.cart}, from "
        f"{worst.start:.2f} to {worst.end:.2f} s ({clean(worst.what)}): this is the main part, not "
        "all of it."
    )


def contenders(gap: Gap) -> tuple[FoundEffect, Rival | None]:
    """Return the two explanations that the data do not tell apart: chosen effect and rival."""
    close = [
        (rival.confidence, i, found, rival)
        for i, found in enumerate(gap.effects)
        for rival in found.rivals
        if rival.nrmse_after <= _AS_GOOD * gap.final and rival.effect.grows_from != found.effect.key
    ]
    if not close:
        return gap.effects[-1], None
    _, _, found, rival = max(close, key=lambda entry: entry[:2])
    return found, rival


# ----------------------------------------------------------------------- phrases


def effect_name(effect: Effect, where: Mapping[str, int]) -> str:
    """Return "dry (Coulomb) friction on cart 2", as it stands inside a sentence."""
    title = effect.title[:1].lower() + effect.title[1:]
    place = place_name(where)
    if not place:
        return title
    named = any(kind in title for kind in where)  # "a hidden mass on a cart"
    return f"{title} ({place})" if named else f"{title} on {place}"


def place_name(where: Mapping[str, int]) -> str:
    """Return "cart 2" or "spring 1"; "" for the input."""
    return " ".join(f"{kind} {number}" for kind, number in where.items())


def sizes_text(parameters: Mapping[str, NamedValue]) -> str:
    """Return "force 0.41 ± 0.01 V, distance 0.02 ± 0.01 cm", for a sentence."""
    return ", ".join(
        f"{name.replace('_', ' ')} {_size(value)}" for name, value in parameters.items()
    )


def _size(value: NamedValue) -> str:
    unit = unit_text(clean(value.unit))
    exact = value.std is not None and value.std < _NEGLIGIBLE * abs(value.value)
    text = significant(value.value) if exact else with_error(value.value, value.std)
    return text + (f" {unit}" if unit else "")


def share(value: float) -> str:
    """Return a share of the motion in percent, with as many digits as matter."""
    digits = 3 if value >= 0.0995 else 2
    return f"{significant(100 * value, digits=digits)} %"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
