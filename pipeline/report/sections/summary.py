"""The summary: what was identified, what agrees, what does not, and what to do next."""

from collections import Counter

from pipeline.names import Name, read_name
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
from pipeline.report.words import clean, name_span, names_spans, plain_lines, rich, stage_name
from pipeline.results import SIGN, Analysis, Check, HardwareCheck

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
_CLOSE = 0.10  # a simulation within 10 % of the motion is a good linear model's


def summary(analysis: Analysis) -> list[Block]:
    """Say what was identified, what agrees, what does not, what is missing, what to do next.

    What is well is a tile on a board; what is not has a sentence as well.
    """
    blocks: list[Block] = [_identified(analysis)]
    blocks += [
        Tiles(tiles) for tiles in (_numbers_board(analysis), _verdict_board(analysis)) if tiles
    ]
    problems = [text for good, text in _findings(analysis) if not good]
    if problems:
        blocks.append(bullet_list(problems))
    return [*blocks, paragraph(Span("What to do next", "strong")), _next(analysis)]


def terminal_summary(analysis: Analysis) -> str:
    """Return the summary as a few lines of plain text."""
    numbers = [
        f"{plain(tile.label)} = {plain(tile.value)} {plain(tile.note)}".rstrip()
        for tile in _numbers_board(analysis)
    ]
    it_has = [paragraph(f"It has {'; '.join(numbers)}.")] if numbers else []
    told = bullet_list(text for _, text in _findings(analysis))
    next_ = [paragraph("What to do next."), _next(analysis)]
    return plain_lines([_identified(analysis), *it_has, told, *next_])


def _findings(analysis: Analysis) -> list[tuple[bool, Spans]]:
    """Return whether each thing found is well, with a sentence about it."""
    found = (_sign, _agreement, _checks, _friction, _design, _hardware, _skipped)
    return [finding for of in found if (finding := of(analysis))]


def _identified(analysis: Analysis) -> Block:
    unused = {one.experiment for one in analysis.left_out}
    kinds = Counter(record.kind for record in analysis.records if record.id not in unused)
    used = listing([count(kinds[kind], noun) for kind, noun in _KINDS.items() if kinds[kind]])
    carts = "single cart" if analysis.carts == 1 else f"chain of {analysis.carts} carts"
    source = f"from {used}" if used else "from the data given"
    fit = analysis.fit
    if fit is None:
        reasons = (
            Span(" The reasons stand under "),
            Span("What was skipped", url="#skipped"),
            Span("."),
        )
        return paragraph(
            Span("No model ", "strong"),
            f"of the {carts} could be identified {source}.",
            reasons if analysis.skipped else (),
        )
    joint = "a fit" if analysis.carts == 1 else "a joint fit of all carts"
    what = {"bode_fit": "the frequency response", "time_fit": "the records in time"}[fit.method]
    quality = (
        "model and stated noise explain the data"
        if fit.explains_data
        else "more than the stated noise is left, so the linear model misses something"
    )
    converged = "" if fit.converged else f" The fit did not converge: {clean(fit.message)}."
    return paragraph(
        Span(f"A {carts} was identified ", "strong"),
        f"{source}, by {joint} to {what} ({fit.n_points} points; χ² per degree of freedom "
        f"{significant(fit.chi_square_per_dof, digits=3)}: {quality}).{converged}",
    )


def _numbers_board(analysis: Analysis) -> tuple[Tile, ...]:
    """Return the gains and the resonances."""
    return tuple(
        Tile(
            label=spans(name_span(row.name)),
            value=spans(with_error(row.final.value, row.final.std)),
            note=spans(unit_text(clean(row.unit))),
        )
        for row in analysis.rows
        if row.final and (analysis.carts == 1 or _is_told(read_name(row.name)))
    )


def _is_told(name: Name) -> bool:
    return name.is_gain or (name.is_frequency and name.is_mode)


def _verdict_board(analysis: Analysis) -> tuple[Tile, ...]:
    """Return what agrees and what does not, each leading to its section."""
    tiles = []
    if fit := analysis.fit:
        good = fit.converged and fit.explains_data
        tiles.append(
            Tile(
                label=spans("χ² per degree of freedom"),
                value=spans(significant(fit.chi_square_per_dof, digits=3)),
                note=spans(
                    "noise explains the rest" if good else "the linear model misses something"
                ),
                tone=_tone(good),
                url="#frequency-response" if analysis.frequency_responses else "#parameters",
            )
        )
    judged = [row.consistent for row in analysis.rows if row.consistent is not None]
    if judged:
        agree = sum(judged)
        note = "parameters agree" if agree == len(judged) else "parameters agree, the rest differ"
        tiles.append(_tally("Measured in two ways", agree, len(judged), note, "#parameters"))
    done = [check.outcome == "pass" for check in analysis.checks if check.outcome != "skip"]
    if done:
        tiles.append(_tally("Consistency checks", sum(done), len(done), "checks passed", "#checks"))
    if design := analysis.feedback:
        settling = design.settling_time
        tiles.append(
            Tile(
                label=spans(f"Feedback, cart {design.cart}"),
                value=spans(f"{significant(settling, digits=3)} s" if settling else NOTHING),
                note=spans(
                    f"to settle, {percent(design.overshoot_percent)} overshoot: goal "
                    f"{'met' if design.reachable else 'not met'}"
                ),
                tone=_tone(design.reachable),
                url="#feedback",
            )
        )
    if analysis.hardware:
        best, worst = _extremes(analysis)
        tiles.append(
            Tile(
                label=spans("Bench against model"),
                value=spans(_range(best, worst).replace(" to ", "–")),
                note=spans("of the motion apart"),
                tone=_tone(worst.nrmse <= _CLOSE),
                url="#hardware",
            )
        )
    return tuple(tiles)


def _tally(label: str, good: int, of: int, note: str, url: str) -> Tile:
    return Tile(spans(label), spans(f"{good} of {of}"), spans(note), _tone(good == of), url)


def _tone(good: bool) -> Tone:
    return "good" if good else "bad"


def _sign(analysis: Analysis) -> tuple[bool, Spans] | None:
    """Everything that follows hangs on it, so it comes first."""
    wrong = _wrong_sign(analysis)
    return (False, spans(Span("Wrong sign: ", "strong"), wrong)) if wrong else None


def _wrong_sign(analysis: Analysis) -> str:
    return next((clean(c.message) for c in analysis.checks if c.id == SIGN), "")


def _agreement(analysis: Analysis) -> tuple[bool, Spans] | None:
    judged = [row for row in analysis.rows if row.consistent is not None]
    if not judged:
        return None
    off = [row for row in judged if not row.consistent]
    two_ways = f"{count(len(judged), 'parameter')} measured in two ways"
    if not off:
        return True, spans(Span("Agrees: ", "strong"), f"all {two_ways}.")
    changes = [f"{row.name} ({percent(row.change_percent, signed=True)})" for row in off]
    return False, spans(
        Span("Does not agree: ", "strong"),
        rich(listing(changes)),
        f". The rest of the {two_ways} agree.",
    )


def _checks(analysis: Analysis) -> tuple[bool, Spans] | None:
    done = [c for c in analysis.checks if c.outcome != "skip"]
    failed = [c for c in done if c.outcome == "fail"]
    if not done:
        return None
    if not failed:
        return True, spans(
            Span("Consistent: ", "strong"), f"all {count(len(done), 'check')} passed."
        )
    # Initial against final and dry friction are told on their own; of each kind, the first.
    kinds: dict[str, Check] = {}
    for check in failed:
        kind = check.id.partition(".")[0]
        if check.id != SIGN and not kind.startswith(("initial_final", "decay")):
            kinds.setdefault(kind, check)
    told = list(kinds.values())[:_MOST_TOLD]
    return False, spans(
        Span("Inconsistent: ", "strong"),
        f"{len(failed)} of {count(len(done), 'check')} failed.",
        rich(clean("".join(f" {_sentence(check.message)}" for check in told))),
        *([Span(" The report lists all under "), Span("Consistency checks", url="#checks"),
           Span(".")] if len(failed) > len(told) else []),
    )  # fmt: skip


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?", "!")) else f"{text}."


def _friction(analysis: Analysis) -> tuple[bool, Spans] | None:
    carts = sorted({d.cart for d in analysis.log_decrements if d.friction and d.friction.present})
    if not carts:
        return None
    return False, spans(
        Span("Dry friction ", "strong"),
        f"shows in the decays of {_carts(carts)}: the damping ratio there depends on the "
        "amplitude, and a single number for it is biased.",
    )


def _design(analysis: Analysis) -> tuple[bool, Spans] | None:
    design = analysis.feedback
    if design is None:
        return None
    settles = (
        "does not settle within the simulated time"
        if design.settling_time is None
        else f"settles in {significant(design.settling_time, digits=3)} s"
    )
    verdict = "meets the goal" if design.reachable else "cannot meet the goal"
    return design.reachable, spans(
        Span("Feedback ", "strong"),
        f"for cart {design.cart} {verdict}: the simulated step {settles} with "
        f"{percent(design.overshoot_percent)} overshoot.",
    )


def _hardware(analysis: Analysis) -> tuple[bool, Spans] | None:
    if not analysis.hardware:
        return None
    best, worst = _extremes(analysis)
    return worst.nrmse <= _CLOSE, spans(
        Span("Hardware: ", "strong"),
        f"measured and modelled motion differ by {_range(best, worst)} of the motion "
        f"(root mean square), most at cart {worst.cart} in {clean(worst.experiment)}.",
    )


def _extremes(analysis: Analysis) -> tuple[HardwareCheck, HardwareCheck]:
    ordered = sorted(analysis.hardware, key=lambda check: check.nrmse)
    return ordered[0], ordered[-1]


def _range(best: HardwareCheck, worst: HardwareCheck) -> str:
    low, high = percent(100 * best.nrmse), percent(100 * worst.nrmse)
    return low if low == high else f"{low.removesuffix(' %')} to {high}"


def _skipped(analysis: Analysis) -> tuple[bool, Spans] | None:
    if not analysis.skipped:
        return None
    names = list(dict.fromkeys(stage_name(skip.stage) for skip in analysis.skipped))
    more = len(names) - _MOST_TOLD
    stages = listing(names[:_MOST_TOLD] + ([f"{more} more"] if more > 0 else []))
    return False, spans(
        Span("Skipped: ", "strong"),
        f"{stages}; the report has the reasons under ",
        Span("What was skipped", url="#skipped"),
        ".",
    )


def _carts(carts: list[int]) -> str:
    word = "cart" if len(carts) == 1 else "carts"
    return f"{word} {listing([str(cart) for cart in carts])}"


# ------------------------------------------------------------------------ next


def _next(analysis: Analysis) -> Items:
    if wrong := _wrong_sign(analysis):  # what else is odd may come from it
        return bullet_list([spans(wrong), spans("Then make the report again.")])
    advice: list[Spans] = []
    fit = analysis.fit
    for what, which in (
        ("Give a sound file, or the right name of it, for", list(analysis.unreadable)),
        ("Mend or record again", [one.experiment for one in analysis.left_out]),
    ):
        if which:
            more = " …" if len(which) > _MOST_TOLD else ""
            named = clean(listing(which[:_MOST_TOLD]))
            advice.append(spans(f"{what} {named}{more}: the checks say what is wrong."))
    if not advice and any(
        c.outcome == "fail" and c.id.startswith(_OF_DATA) for c in analysis.checks
    ):
        advice.append(spans("Mend first what the failed checks say of the recordings."))
    if fit is None and not analysis.left_out:
        reasons = [skip.reason for skip in analysis.skipped if skip.stage == "final estimates"]
        advice.append(
            spans(f"No carts were identified: {clean(reasons[-1])}")
            if reasons
            else spans(
                "Record what the fit needs: sine dwells over the resonances, a step or a sweep."
            )
        )
    off = [row.name for row in analysis.rows if row.consistent is False]
    if off:
        advice.append(
            spans(
                "Look again at how ",
                names_spans(off),
                " came about: the figures of the decays, steps and dwells show what was used.",
            )
        )
    short = sorted({point.experiment for point in analysis.sine_points if not point.settled})
    if short:
        advice.append(
            spans(f"Record {clean(listing(short))} again and longer: no steady state was reached.")
        )
    if any(d.friction and d.friction.present for d in analysis.log_decrements):
        advice.append(
            spans(
                "Repeat a decay from two release heights: a viscous damping ratio stays the same, "
                "with dry friction it grows as the amplitude falls."
            )
        )
    doubted = {check.experiment for check in analysis.hardware if check.contradicted}
    poor = [c for c in analysis.hardware if c.nrmse > _CLOSE and c.experiment not in doubted]
    if poor or (fit is not None and not fit.explains_data):
        advice.append(
            spans(
                "Find what the linear model leaves out: compare where in the records the "
                "difference arises (near rest, at speed, at large swings)."
            )
        )
    if analysis.feedback is not None and not any(r.kind == "closed_loop" for r in analysis.records):
        advice.append(spans("Run the designed feedback on the bench and add the record."))
    if analysis.skipped and not analysis.left_out:
        advice.append(spans("Add the experiments that the skipped stages ask for."))
    design = analysis.feedback
    if design and not design.reachable:
        advice.append(spans(f"Relax the goal of the design: {clean(design.message)}."))
    if not advice and any(check.outcome == "fail" for check in analysis.checks):
        advice.append(spans("Look into what the failed checks say."))
    if not advice and analysis.warnings:
        advice.append(spans("Look into the report's ", Span("Warnings", url="#warnings"), "."))
    if not advice:
        advice.append(spans("Nothing stands out. Discuss the remaining differences in the notes."))
    return bullet_list(advice)
