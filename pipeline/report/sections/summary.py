"""The summary: what was identified, what agrees, what does not, and what to do next."""

from collections import Counter
from collections.abc import Iterator, Sequence

from pipeline.names import Name, read_name
from pipeline.report import limits
from pipeline.report.document import (
    Block,
    Items,
    Span,
    Spans,
    Tile,
    Tiles,
    Tone,
    bullet_list,
    paragraph,
    plain,
    spans,
)
from pipeline.report.numbers import (
    NOTHING,
    count,
    listing,
    percent,
    significant,
    unit_text,
    with_error,
)
from pipeline.report.phrases import phrases
from pipeline.report.sections.measurements import overview_blocks
from pipeline.report.sections.page import Page
from pipeline.report.sections.parameters import reported_off
from pipeline.report.words import clean, name_span, names_spans, plain_lines, rich
from pipeline.results import SIGN, Analysis, Check, Estimate, HardwareCheck

_WORDS = phrases("summary")
_KINDS = {  # what carts are identified from
    "decay": "decay",
    "step": "step",
    "sine": "sine dwell",
    "sweep": "sweep",
    "bode": "table of amplitude ratios",
}
_MOST_TOLD = 3  # of one kind: a summary is short
_OF_DATA = (
    "repeats.",
    "dwells.",
    "setup.",
    "hardware.",
)  # checks of recordings, not of what they say


def summary(page: Page) -> list[Block]:
    """Say what was identified, what agrees, what does not, what is missing, what to do next.

    What is well is a tile on a board; what is not has a sentence as well. One picture shows all
    carts.
    """
    analysis = page.analysis
    blocks: list[Block] = [_identified(analysis)]
    blocks += [
        Tiles(tiles) for tiles in (_numbers_board(analysis), _verdict_board(analysis)) if tiles
    ]
    problems = [text for good, text in _findings(analysis) if not good]
    if problems:
        blocks.append(bullet_list(problems))
    blocks += overview_blocks(page)
    return [*blocks, paragraph(Span(_WORDS.text("next"), "strong")), _next(analysis)]


def terminal_summary(analysis: Analysis) -> str:
    """Return the summary as a few lines of plain text."""
    numbers = [
        f"{plain(tile.label)} = {plain(tile.value)} {plain(tile.note)}".rstrip()
        for tile in _numbers_board(analysis, error="share")
    ]
    only = f" {_WORDS.text('statistical_only')}" if any("±" in text for text in numbers) else ""
    it_has = [paragraph(f"It has {'; '.join(numbers)}.{only}")] if numbers else []
    told = bullet_list(text for _, text in _findings(analysis))
    next_ = [paragraph(f"{_WORDS.text('next')}."), _next(analysis)]
    return plain_lines([_identified(analysis), *it_has, told, *next_])


def _findings(analysis: Analysis) -> list[tuple[bool, Spans]]:
    """Return whether each thing found is well, with a sentence about it."""
    found = (_sign, _agreement, _undecided, _checks, _friction, _design, _hardware, _skipped)
    return [finding for of in found if (finding := of(analysis))]


def _identified(analysis: Analysis) -> Block:
    unused = {one.experiment for one in analysis.left_out}
    kinds = Counter(record.kind for record in analysis.records if record.id not in unused)
    used = listing([count(kinds[kind], noun) for kind, noun in _KINDS.items() if kinds[kind]])
    single, fit = analysis.carts == 1, analysis.fit
    carts = _WORDS.text("one_cart" if single else "carts", n=analysis.carts)
    source = _WORDS.text("from_runs" if used else "from_data", runs=used)
    if fit is None:
        reasons = _WORDS.spans("reasons") if analysis.skipped else ""
        return paragraph(
            _WORDS.spans("not_identified", carts=carts, source=source, reasons=reasons)
        )
    failed = "" if fit.converged else _WORDS.text("not_converged", message=clean(fit.message))
    return paragraph(
        _WORDS.spans(
            "identified",
            carts=carts,
            source=source,
            fit=_WORDS.text("one_fit" if single else "joint_fit"),
            what=_WORDS.text(fit.method),
            points=str(fit.n_points),
            chi_square=significant(fit.chi_square_per_dof, digits=3),
            quality=_WORDS.text("explained" if fit.explains_data else "unexplained"),
            failed=failed,
        )
    )


def _numbers_board(analysis: Analysis, *, error: str = "statistical") -> tuple[Tile, ...]:
    """Return the gains and the resonances; `error` words those smaller than a calibration's."""
    return tuple(
        _number_tile(
            row.name,
            row.final,
            unit=unit_text(clean(row.unit)),
            is_sure=_is_explained(analysis),
            error=error,
        )
        for row in analysis.rows
        if row.final and (analysis.carts == 1 or _is_told(read_name(row.name)))
    )


def _is_explained(analysis: Analysis) -> bool:
    """Tell whether the standard errors hold: they rest on noise alone being left."""
    return analysis.fit is not None and analysis.fit.explains_data


def _number_tile(name: str, final: Estimate, *, unit: str, is_sure: bool, error: str) -> Tile:
    """Return a number in four digits; a smaller error than any calibration's is only a note."""
    share = (final.std or 0.0) / abs(final.value) if final.value else 1.0
    if not is_sure:
        value = significant(final.value, digits=limits.UNSURE_DIGITS)
    elif 0 < share < limits.CALIBRATION:
        value = significant(final.value)
        told = _WORDS.text(error, share=f"{significant(100 * share, digits=1)} %")
        unit = f"{unit}, {told}" if unit else told
    else:
        value = with_error(final.value, final.std, digits=2 if share >= limits.COARSE else 1)
    return Tile(label=spans(name_span(name)), value=spans(value), note=spans(unit))


def _is_told(name: Name) -> bool:
    return name.is_gain or (name.is_frequency and name.is_mode)


def _verdict_board(analysis: Analysis) -> tuple[Tile, ...]:
    """Return what agrees and what does not, each leading to its section."""
    tiles = []
    if fit := analysis.fit:
        good = fit.converged and fit.explains_data
        url = "#frequency-response" if analysis.frequency_responses else "#parameters"
        value = significant(fit.chi_square_per_dof, digits=3)
        note = _WORDS.text("tile_explained" if good else "tile_unexplained")
        tiles.append(_tile("tile_chi_square", value, note, good=good, url=url))
    if judged := [row.consistent for row in analysis.rows if row.consistent is not None]:
        key = "tile_agree" if all(judged) else "tile_disagree"
        tiles.append(_tally("tile_two_ways", judged, key, url="#parameters"))
    if done := [c.outcome == "pass" for c in analysis.checks if c.outcome != "skip"]:
        tiles.append(_tally("tile_checks", done, "tile_passed", url="#checks"))
    if design := analysis.feedback:
        settling, good = design.settling_time, design.reachable
        value = f"{significant(settling, digits=3)} s" if settling else NOTHING
        overshoot, verdict = percent(design.overshoot_percent), "met" if good else "not met"
        note = _WORDS.text("tile_settles", overshoot=overshoot, verdict=verdict)
        label = _WORDS.text("tile_feedback", cart=design.cart)
        tiles.append(Tile(spans(label), spans(value), spans(note), _tone(good), "#feedback"))
    if analysis.hardware:
        best, worst = _extremes(analysis)
        good, note = worst.nrmse <= limits.CLOSE, _WORDS.text("tile_apart")
        value = _range(best, worst, to="–")
        tiles.append(_tile("tile_hardware", value, note, good=good, url="#hardware"))
    return tuple(tiles)


def _tile(key: str, value: str, note: str, *, good: bool, url: str) -> Tile:
    return Tile(spans(_WORDS.text(key)), spans(value), spans(note), _tone(good), url)


def _tally(key: str, judged: Sequence[bool | None], note: str, *, url: str) -> Tile:
    good, of = sum(map(bool, judged)), len(judged)
    return _tile(key, f"{good} of {of}", _WORDS.text(note), good=good == of, url=url)


def _tone(good: bool) -> Tone:
    return "good" if good else "bad"


def _sign(analysis: Analysis) -> tuple[bool, Spans] | None:
    """Everything that follows hangs on it, so it comes first."""
    wrong = _wrong_sign(analysis)
    return (False, _WORDS.spans("sign", message=wrong)) if wrong else None


def _wrong_sign(analysis: Analysis) -> str:
    return next((clean(c.message) for c in analysis.checks if c.id == SIGN), "")


def _agreement(analysis: Analysis) -> tuple[bool, Spans] | None:
    judged = [row for row in analysis.rows if row.consistent is not None]
    if not judged:
        return None
    parameters = count(len(judged), "parameter")
    off = [row for row in judged if not row.consistent]
    if not off:
        return True, _WORDS.spans("agree", parameters=parameters)
    changes = [f"{row.name} ({percent(row.change_percent, signed=True)})" for row in off]
    return False, _WORDS.spans("disagree", changes=rich(listing(changes)), parameters=parameters)


def _undecided(analysis: Analysis) -> tuple[bool, Spans] | None:
    """What was measured twice and may be either: a number of the board must not stand alone."""
    told = [
        _WORDS.text(
            "undecided_one",
            name=row.name,
            initial=with_error(row.initial.value, row.initial.std),
            final=with_error(row.final.value, row.final.std),
        )
        for row in analysis.rows
        if row.consistent is None and row.change_sigmas is not None and row.initial and row.final
    ]
    if not told:
        return None
    return False, _WORDS.spans("undecided", parameters=rich(listing(told)))


def _checks(analysis: Analysis) -> tuple[bool, Spans] | None:
    done = [c for c in analysis.checks if c.outcome != "skip"]
    failed = analysis.failed_checks
    if not done:
        return None
    checks = count(len(done), "check")
    if not failed:
        return True, _WORDS.spans("consistent", checks=checks)
    # Initial against final and dry friction are told on their own; of each kind, the first.
    kinds: dict[str, Check] = {}
    for check in failed:
        kind = check.id.partition(".")[0]
        if check.id != SIGN and not kind.startswith(("initial_final", "decay")):
            kinds.setdefault(kind, check)
    told = list(kinds.values())[:_MOST_TOLD]
    said = rich(clean("".join(f" {_sentence(check.message)}" for check in told)))
    more = _WORDS.spans("all_checks") if len(failed) > len(told) else ()
    return False, _WORDS.spans(
        "inconsistent", failed=str(len(failed)), checks=checks, told=(*said, *more)
    )


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?", "!")) else f"{text}."


def _friction(analysis: Analysis) -> tuple[bool, Spans] | None:
    carts = sorted({d.cart for d in analysis.log_decrements if d.friction and d.friction.present})
    return (False, _WORDS.spans("friction", carts=_carts(carts))) if carts else None


def _design(analysis: Analysis) -> tuple[bool, Spans] | None:
    design = analysis.feedback
    if design is None:
        return None
    settling = design.settling_time
    settles = (
        _WORDS.text("never_settles")
        if settling is None
        else _WORDS.text("settles", seconds=significant(settling, digits=3))
    )
    return design.reachable, _WORDS.spans(
        "feedback",
        cart=str(design.cart),
        verdict=_WORDS.text("met" if design.reachable else "not_met"),
        settles=settles,
        overshoot=percent(design.overshoot_percent),
    )


def _hardware(analysis: Analysis) -> tuple[bool, Spans] | None:
    if not analysis.hardware:
        return None
    best, worst = _extremes(analysis)
    return worst.nrmse <= limits.CLOSE, _WORDS.spans(
        "hardware",
        range=_range(best, worst, to=" to "),
        cart=str(worst.cart),
        run=clean(worst.experiment),
    )


def _extremes(analysis: Analysis) -> tuple[HardwareCheck, HardwareCheck]:
    ordered = sorted(analysis.hardware, key=lambda check: check.nrmse)
    return ordered[0], ordered[-1]


def _range(best: HardwareCheck, worst: HardwareCheck, *, to: str) -> str:
    low, high = percent(100 * best.nrmse), percent(100 * worst.nrmse)
    return low if low == high else f"{low.removesuffix(' %')}{to}{high}"


def _skipped(analysis: Analysis) -> tuple[bool, Spans] | None:
    if not analysis.skipped:
        return None
    names = list(dict.fromkeys(clean(skip.stage) for skip in analysis.skipped))
    more = len(names) - _MOST_TOLD
    # A name has commas in it: "log decrement, decay-1, cart 1".
    stages = "; ".join(names[:_MOST_TOLD] + ([f"{more} more"] if more > 0 else []))
    return False, _WORDS.spans("skipped", stages=stages)


def _carts(carts: list[int]) -> str:
    word = "cart" if len(carts) == 1 else "carts"
    return f"{word} {listing([str(cart) for cart in carts])}"


# ------------------------------------------------------------------------ next


def _next(analysis: Analysis) -> Items:
    if wrong := _wrong_sign(analysis):  # what else is odd may come from it
        return bullet_list([spans(wrong), _WORDS.spans("next_again")])
    return bullet_list(list(_advice(analysis)) or [_look_into(analysis)])


def _advice(analysis: Analysis) -> Iterator[Spans]:
    """Yield what to do about each thing that is not well."""
    say, fit, design = _WORDS.spans, analysis.fit, analysis.feedback
    unreadable, left_out = list(analysis.unreadable), [o.experiment for o in analysis.left_out]
    for key, runs in (("next_unreadable", unreadable), ("next_left_out", left_out)):
        if runs:
            more = " …" if len(runs) > _MOST_TOLD else ""
            yield say(key, runs=clean(listing(runs[:_MOST_TOLD])) + more)
    if not (unreadable or left_out) and any(
        c.id.startswith(_OF_DATA) for c in analysis.failed_checks
    ):
        yield say("next_recordings")
    reasons: list[str] = []
    if fit is None and not left_out:
        reasons = [skip.reason for skip in analysis.skipped if skip.stage == "final estimates"]
        yield (say("next_no_carts", reason=clean(reasons[-1])) if reasons else say("next_no_data"))
    if off := [row.name for row in analysis.rows if row.consistent is False]:
        yield say("next_off", names=names_spans(off))
    if wrong := list(dict.fromkeys(reported_off(analysis))):
        yield say("next_reported", names=names_spans(wrong))
    if _may_lack_springs(analysis):
        yield say("next_springs")
    if short := sorted({point.experiment for point in analysis.sine_points if not point.settled}):
        yield say("next_short", runs=clean(listing(short)))
    if any(d.friction and d.friction.present for d in analysis.log_decrements):
        yield say("next_friction")
    doubted = {check.experiment for check in analysis.hardware if check.contradicted}
    poor = [c for c in analysis.hardware if c.nrmse > limits.CLOSE and c.experiment not in doubted]
    if poor or (fit is not None and not fit.explains_data):
        yield say("next_left")
    if design is not None and not any(r.kind == "closed_loop" for r in analysis.records):
        yield say("next_run")
    unread = {f"reading {name}" for name in analysis.unreadable}  # asked for above
    stages = {skip.stage for skip in analysis.skipped} - unread
    if stages and not left_out and not reasons:  # what follows the carts waits for them
        yield say("next_skipped")
    if design and not design.reachable:
        yield say("next_goal", message=clean(design.message))


def _may_lack_springs(analysis: Analysis) -> bool:
    """Tell whether steps contradict a fit that leaves springs out, where dry friction does not."""
    fit, dry = analysis.fit, any(d.friction and d.friction.present for d in analysis.log_decrements)
    off = any(row.consistent is False and read_name(row.name).is_gain for row in analysis.rows)
    return off and not dry and fit is not None and not (fit.explains_data or all(analysis.springs))


def _look_into(analysis: Analysis) -> Spans:
    """Return what is left to do where nothing asks for more."""
    if analysis.failed_checks:
        return _WORDS.spans("next_checks")
    return _WORDS.spans("next_warnings" if analysis.warnings else "next_nothing")
