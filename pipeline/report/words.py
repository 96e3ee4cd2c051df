"""Plain words: the summary, what to do next, and parameter names inside sentences."""

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable

from pipeline.report.document import (
    Block,
    Items,
    Paragraph,
    Span,
    Spans,
    bullet_list,
    paragraph,
    plain,
    spans,
)
from pipeline.report.mathematics import GREEK, symbol
from pipeline.report.numbers import count, listing, percent, significant, unit_text, with_error
from pipeline.results import Analysis, HardwareCheck

SOURCES = {
    "step": "step",
    "log_decrement": "decay",
    "bode_fit": "Bode fit",
    "time_fit": "fit in time",
    "assumed": "assumed",
    "frequency_response": "response",
}
KINDS = {
    "decay": "decay",
    "step": "step",
    "sine": "sine dwell",
    "sweep": "sweep",
    "closed_loop": "closed-loop run",
    "bode": "table of amplitude ratios",
}
_GOOD_FIT = 2.0  # chi-square per degree of freedom that stated noise still explains
_MOST_TOLD = 3  # of one kind: a summary is short
_CLOSE = 0.10  # a simulation within 10 % of the motion is a good linear model's

_NAME = re.compile(r"\b(?:omega|zeta|K|X|m|c|k)_(?:\d|[a-h]|[nxy])\b|\b(?:omega|zeta)\b")


def rich(text: str) -> Spans:
    """Return our own sentence with parameter names such as `omega_a` as mathematics."""
    parts: list[Span] = []
    end = 0
    for match in _NAME.finditer(text):
        parts += [Span(text[end : match.start()]), name_span(match[0])]
        end = match.end()
    return tuple(part for part in (*parts, Span(text[end:])) if part.text)


def name_span(name: str) -> Span:
    """Return one parameter name as mathematics, with its plain form as text."""
    base, _, index = name.partition("_")
    plain = GREEK.get(base, base) + (f"_{index}" if index else "")
    return Span(plain, math=symbol(name))


def names_spans(names: list[str]) -> Spans:
    """Return "K_1, K_2 and omega_a" with the names as mathematics."""
    return rich(listing(names))


def clean(text: str) -> str:
    """Return text without control and unassigned characters, which no page can show."""
    return "".join(
        c if c in "\n\t" or unicodedata.category(c)[0] != "C" else "�"
        for c in text.replace("\r\n", "\n")
    )


# --------------------------------------------------------------------- summary


def summary(analysis: Analysis) -> list[Block]:
    """Say what was identified, what agrees, what does not, what is missing, what to do next."""
    blocks: list[Block] = [_identified(analysis)]
    points = [_agreement(analysis), _checks(analysis), _friction(analysis), _design(analysis)]
    points += [_hardware(analysis), _skipped(analysis)]
    blocks.append(bullet_list([point for point in points if point]))
    blocks.append(paragraph(Span("What to do next.", "strong")))
    blocks.append(_next(analysis))
    return blocks


def terminal_summary(analysis: Analysis) -> str:
    """Return the summary as a few lines of plain text."""
    return plain_lines(summary(analysis))


def plain_lines(blocks: Iterable[Block]) -> str:
    """Return paragraphs and lists as lines of plain text."""
    lines = []
    for block in blocks:
        if isinstance(block, Paragraph):
            lines.append(plain(block.text))
        elif isinstance(block, Items):
            items = (inner for item in block.items for inner in item)
            lines += [f"- {plain(inner.text)}" for inner in items if isinstance(inner, Paragraph)]
    return "\n".join(lines)


def _identified(analysis: Analysis) -> Block:
    kinds = Counter(record.kind for record in analysis.records)
    used = listing([count(kinds[kind], noun) for kind, noun in KINDS.items() if kinds[kind]])
    carts = "single cart" if analysis.carts == 1 else f"chain of {analysis.carts} carts"
    source = f"from {used}" if used else "from the data given"
    fit = analysis.fit
    if fit is None:
        reasons = (Span(" The reasons stand "), Span("below", url="#skipped"), Span("."))
        return paragraph(
            Span("No model ", "strong"),
            f"of the {carts} could be identified {source}.",
            reasons if analysis.skipped else (),
        )
    joint = "a fit" if analysis.carts == 1 else "a joint fit of all carts"
    what = {"bode_fit": "the frequency response", "time_fit": "the records in time"}[fit.method]
    quality = (
        "model and stated noise explain the data"
        if fit.chi_square_per_dof <= _GOOD_FIT
        else "more than the stated noise is left, so the linear model misses something"
    )
    converged = "" if fit.converged else f" The fit did not converge: {clean(fit.message)}."
    return paragraph(
        Span(f"A {carts} was identified ", "strong"),
        f"{source}, by {joint} to {what} ({fit.n_points} points; χ² per degree of freedom "
        f"{significant(fit.chi_square_per_dof, digits=3)}: {quality}).{converged} ",
        *_key_numbers(analysis),
    )


def _key_numbers(analysis: Analysis) -> Spans:
    finals = {row.name: row for row in analysis.rows if row.final}
    keys = ["K", "omega_n", "zeta", "mass", "damping"]
    keys += [f"K_{i}" for i in range(1, analysis.carts + 1)]
    keys += [f"omega_{mode}" for mode in "abcd"[: analysis.carts]]
    parts: list[Span] = []
    for name in keys:
        row = finals.get(name)
        if row is None or row.final is None:
            continue
        unit = f" {unit_text(clean(row.unit))}" if row.unit else ""
        value = with_error(row.final.value, row.final.std)
        parts += [Span("; " if parts else ""), name_span(name), Span(f" = {value}{unit}")]
    return spans("It has ", tuple(parts), ".") if parts else ()


def _agreement(analysis: Analysis) -> Spans:
    judged = [row for row in analysis.rows if row.consistent is not None]
    if not judged:
        return ()
    off = [row for row in judged if not row.consistent]
    two_ways = f"{count(len(judged), 'parameter')} measured in two ways"
    if not off:
        return spans(Span("Agrees: ", "strong"), f"all {two_ways}.")
    changes = [f"{row.name} ({percent(row.change_percent, signed=True)})" for row in off]
    return spans(
        Span("Does not agree: ", "strong"),
        rich(listing(changes)),
        f". The rest of the {two_ways} agree.",
    )


def _checks(analysis: Analysis) -> Spans:
    done = [c for c in analysis.checks if c.outcome != "skip"]
    failed = [c for c in done if c.outcome == "fail"]
    if not done:
        return ()
    if not failed:
        return spans(Span("Consistent: ", "strong"), f"all {count(len(done), 'check')} passed.")
    # Initial against final and dry friction are told on their own.
    untold = [c for c in failed if not c.id.startswith(("initial_final", "decay"))]
    more = len(failed) > min(len(untold), _MOST_TOLD)
    return spans(
        Span("Inconsistent: ", "strong"),
        f"{len(failed)} of {count(len(done), 'check')} failed. ",
        rich(clean(" ".join(c.message for c in untold[:_MOST_TOLD]))),
        *([Span(" All are listed "), Span("below", url="#checks"), Span(".")] if more else []),
    )


def _friction(analysis: Analysis) -> Spans:
    carts = sorted({d.cart for d in analysis.log_decrements if d.friction and d.friction.present})
    if not carts:
        return ()
    return spans(
        Span("Dry friction ", "strong"),
        f"shows in the decays of {_carts(carts)}: the damping ratio there depends on the "
        "amplitude, and a single number for it is biased.",
    )


def _design(analysis: Analysis) -> Spans:
    design = analysis.feedback
    if design is None:
        return ()
    settles = (
        "does not settle within the simulated time"
        if design.settling_time is None
        else f"settles in {significant(design.settling_time, digits=3)} s"
    )
    verdict = "meets the goal" if design.reachable else "cannot meet the goal"
    return spans(
        Span("Feedback ", "strong"),
        f"for cart {design.cart} {verdict}: the simulated step {settles} with "
        f"{percent(design.overshoot_percent)} overshoot.",
    )


def _hardware(analysis: Analysis) -> Spans:
    if not analysis.hardware:
        return ()
    worst = max(analysis.hardware, key=lambda check: check.nrmse)
    best = min(analysis.hardware, key=lambda check: check.nrmse)
    return spans(
        Span("Hardware: ", "strong"),
        f"measured and modelled motion differ by {_range(best, worst)} of the motion "
        f"(root mean square), most at cart {worst.cart} in {clean(worst.experiment)}.",
    )


def _range(best: HardwareCheck, worst: HardwareCheck) -> str:
    low, high = percent(100 * best.nrmse), percent(100 * worst.nrmse)
    return low if low == high else f"{low.removesuffix(' %')} to {high}"


def _skipped(analysis: Analysis) -> Spans:
    if not analysis.skipped:
        return ()
    names = list(dict.fromkeys(stage_name(skip.stage) for skip in analysis.skipped))
    more = len(names) - _MOST_TOLD
    stages = listing(names[:_MOST_TOLD] + ([f"{more} more"] if more > 0 else []))
    return spans(
        Span("Skipped: ", "strong"),
        f"{stages}; the reasons are ",
        Span("below", url="#skipped"),
        ".",
    )


def stage_name(stage: str) -> str:
    """Return a stage's name as words."""
    return clean(stage).replace("_", " ")


def _carts(carts: list[int]) -> str:
    word = "cart" if len(carts) == 1 else "carts"
    return f"{word} {listing([str(cart) for cart in carts])}"


# ------------------------------------------------------------------------ next


def _next(analysis: Analysis) -> Items:
    advice: list[Spans] = []
    fit = analysis.fit
    if fit is None:
        advice.append(
            spans("Record what the fit needs: sine dwells over the resonances, a step or a sweep.")
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
    poor = [check for check in analysis.hardware if check.nrmse > _CLOSE]
    if poor or (fit is not None and fit.chi_square_per_dof > _GOOD_FIT):
        advice.append(
            spans(
                "Find what the linear model leaves out: compare where in the records the "
                "difference arises (near rest, at speed, at large swings)."
            )
        )
    if analysis.feedback is not None and not any(r.kind == "closed_loop" for r in analysis.records):
        advice.append(spans("Run the designed feedback on the bench and add the record."))
    if analysis.skipped:
        advice.append(spans("Add the experiments that the skipped stages ask for."))
    if not advice:
        advice.append(spans("Nothing stands out. Discuss the remaining differences in the notes."))
    return bullet_list(advice)
