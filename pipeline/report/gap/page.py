"""The gap report: the verdict on one page, then the story step by step."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline import __version__
from pipeline.gap.residual_force import ResidualForce, residual_forces
from pipeline.gap.types import FoundEffect, Gap, RecordGap, Trace
from pipeline.plant.effects.base import Term
from pipeline.report.document import (
    Block,
    Details,
    Document,
    Section,
    Span,
    bullet_list,
    paragraph,
    spans,
)
from pipeline.report.equations.effects import augmented_equations, law
from pipeline.report.figures.gap import (
    before_after_figure,
    by_record_figure,
    force_figure,
    spectrum_figure,
    timing_figure,
)
from pipeline.report.figures.style import drawing
from pipeline.report.gap.tables import (
    effect_parameter_table,
    error_table,
    rival_table,
    window_table,
)
from pipeline.report.gap.words import (
    contenders,
    effect_name,
    error_board,
    next_block,
    place_name,
    share,
    verdict_blocks,
    verdict_title,
)
from pipeline.report.numbers import count, listing, percent
from pipeline.report.render.write import write_document
from pipeline.report.sections.page import Page, left_out, remarks
from pipeline.report.tables import chain_table, file_table
from pipeline.report.words import clean
from pipeline.results import Analysis

_MOST_ROWS = 28  # runs in the overview; the JSON has all
_MORE_TRACES = 3  # drawn after the one in the summary


def render_gap(
    gap: Gap,
    analysis: Analysis,
    out: Path,
    *,
    pdf: bool = True,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write `gap.html`, `gap.pdf` and `figures/*.svg` into the folder `out`."""
    document = build_gap_document(gap, analysis, progress=progress)
    write_document(document, out, name="gap", pdf=pdf)


def build_gap_document(
    gap: Gap, analysis: Analysis, *, progress: Callable[[str], None] | None = None
) -> Document:
    """Return the gap report; sections that have nothing to show are left out."""
    page = Page.of(analysis)
    worst = _worst_first(gap)
    forces = residual_forces(gap, free={record.id: record.free for record in analysis.records})
    parts: list[tuple[str, str, Callable[[], list[Block]]]] = [
        ("summary", verdict_title(gap), lambda: _summary(page, gap, worst[:1])),
        ("where", "Where the linear model fails", lambda: _where(page, gap)),
    ]
    for i, found in enumerate(gap.effects):
        name = effect_name(found.effect, found.where)
        title = f"Suspect: {name}" if gap.verdict == "unexplained" else name
        parts.append(
            (
                f"effect-{i + 1}",
                title[:1].upper() + title[1:],
                lambda i=i: _effect(page, gap, i, forces=forces),
            )
        )
    parts += [
        ("runs", "Measured against simulated", lambda: _runs(page, gap, worst[1:])),
        ("apart", "What would tell the explanations apart", lambda: _apart(gap)),
        ("model", "The model with its effects", lambda: _model(page, gap)),
        ("method", "How this was found", lambda: _method(gap)),
        ("warnings", "Warnings", lambda: remarks(list(analysis.warnings))),
        ("provenance", "Provenance", lambda: _provenance(page, gap)),
    ]
    sections = []
    with drawing():
        for id_, title, blocks_of in parts:
            if progress:
                progress(f"gap report: {title.lower()}")
            if blocks := blocks_of():
                sections.append(Section(id=id_, title=title, blocks=tuple(blocks)))
    return page.document(
        sections,
        about="What the linear model leaves out",
        untitled=f"The gap of {count(analysis.carts, 'cart')}",
    )


# --------------------------------------------------------------------- the page


def _summary(page: Page, gap: Gap, worst: Sequence[Trace]) -> list[Block]:
    blocks = [*verdict_blocks(gap), error_board(gap), error_table(gap, number=page.table_number())]
    blocks += [_before_after(page, gap, trace, number=1) for trace in worst]
    return blocks + next_block(gap)


def _where(page: Page, gap: Gap) -> list[Block]:
    rows = sorted(gap.by_record, key=lambda row: (not row.held_out, -row.baseline))
    if not rows:
        return []
    shown = rows[:_MOST_ROWS]
    top = shown[0]
    blocks: list[Block] = [
        page.picture(
            "by-record",
            by_record_figure(shown),
            caption="Error of each run and cart before (ring) and after (dot); the tick is what "
            "noise alone makes. Names in black were held out: the models were not fitted to them."
            f"{left_out(len(rows) - len(shown))}",
            alt=f"Errors of {count(len(shown), 'run')} on a logarithmic axis. The worst held-out "
            f"one is {top.experiment}, cart {top.cart}: {share(top.baseline)} before, "
            f"{share(top.final)} after, noise {share(top.noise_floor)}.",
        )
    ]
    if gap.where:
        number = page.table_number()
        blocks.append(window_table(gap.where, model="the linear model", number=number))
    return blocks


def _before_after(page: Page, gap: Gap, trace: Trace, *, number: int) -> Block:
    row = _row(gap, trace)
    size = page_noise = 0.0
    if row is not None and row.final > 0:
        left = trace.measured - trace.final
        size = float((left**2).mean() ** 0.5) / row.final
        page_noise = row.noise_floor * size
    errors = (
        f" Error {share(row.baseline)} of the motion before, {share(row.final)} after; noise "
        f"{share(row.noise_floor)}."
        if row
        else ""
    )
    held = "held out, so no model was fitted to it" if trace.held_out else "used to fit"
    return page.picture(
        f"before-after-{number}",
        before_after_figure(trace, noise=page_noise, position_unit=page.position),
        caption=f"Cart {trace.cart} in {trace.experiment} ({held}): measured and simulated, and "
        f"what each model leaves (the band is twice the noise).{errors}",
        alt=f"Measured motion of cart {trace.cart} in {trace.experiment} with the linear model and "
        f"the model with its effects.{errors}",
    )


# ------------------------------------------------------------------- the effects


def _effect(page: Page, gap: Gap, index: int, *, forces: Sequence[ResidualForce]) -> list[Block]:
    found = gap.effects[index]
    effect = found.effect
    terms = _terms(gap)
    step = (
        f"Added to the model, it takes the error on held-out runs from "
        f"{share(found.nrmse_before)} of the motion to {share(found.nrmse_after)}."
    )
    blocks: list[Block] = [
        paragraph(effect.sentence, f" {step}"),
        law(terms, index),
        *_evidence(page, gap, found, forces=forces, number=index + 1),
        effect_parameter_table(found, number=page.table_number()),
    ]
    if found.rivals:
        blocks.append(rival_table(found, gap, number=page.table_number()))
    facts = [
        ("Its fingerprint: ", effect.fingerprint),
        ("The run that decides: ", effect.deciding_run),
        ("What these data could not tell from it: ", effect.equivalent),
        ("Read: ", f"{effect.reference}."),
    ]
    blocks.append(bullet_list(spans(Span(lead, "strong"), text) for lead, text in facts if text))
    return blocks


def _evidence(
    page: Page, gap: Gap, found: FoundEffect, *, forces: Sequence[ResidualForce], number: int
) -> list[Block]:
    """Return the figure that shows the effect: force against what causes it, or in time."""
    name = effect_name(found.effect, found.where)
    others = " Other effects act in the same runs and are part of both." * (len(gap.effects) > 1)
    axis = found.effect.axis
    if axis == "frequency":
        held_out = [trace for trace in gap.traces if trace.held_out]
        if not held_out:
            return []
        figure = spectrum_figure(held_out, position_unit=page.position)
        caption = (
            "Amplitude over frequency in the held-out runs: the motion, and what the models leave."
        )
    elif axis == "time":
        figure = timing_figure(forces, drive=page.drive)
        caption = (
            "The force that reaches cart 1 around an edge of the input: masses, dampings and "
            f"springs times the measured motion, against the logged input.{others}"
        )
    else:
        figure = force_figure(found, forces, units=(page.position, page.drive))
        caption = (
            "The force that masses, dampings and springs do not account for, each point a mean "
            "over a short window of a run; the same from the motion that the model with "
            f"its effects gives.{others}"
        )
    if figure is None:
        return []
    return [
        page.picture(
            f"effect-{number}",
            figure,
            caption=f"The evidence for {name}. {caption}",
            alt=f"Evidence for {name}: measured points and model against "
            f"{'time' if axis == 'time' else axis}. {found.effect.fingerprint}",
        )
    ]


# --------------------------------------------------------------- runs and rivals


def _runs(page: Page, gap: Gap, worst: Sequence[Trace]) -> list[Block]:
    blocks = [
        _before_after(page, gap, trace, number=i)
        for i, trace in enumerate(worst[:_MORE_TRACES], start=2)
    ]
    if gap.left and gap.effects:
        number = page.table_number()
        blocks.append(window_table(gap.left, model="the model with its effects", number=number))
    return blocks


def _apart(gap: Gap) -> list[Block]:
    if gap.verdict != "ambiguous":
        return []
    last, rival = contenders(gap)
    pair = [(last.effect, last.where), *([(rival.effect, rival.where)] if rival else [])]
    return [
        paragraph(
            "Both explanations leave errors too alike to choose by. The experiments that each of "
            "them asks for:"
        ),
        bullet_list(
            spans(Span(f"{effect_name(effect, where)}: ", "strong"), effect.deciding_run)
            for effect, where in pair
        ),
    ]


# --------------------------------------------------------------------- the model


def _terms(gap: Gap) -> tuple[Term, ...]:
    return gap.model.terms


def _model(page: Page, gap: Gap) -> list[Block]:
    if not gap.model.terms:
        return []
    springs = page.analysis.springs
    blocks: list[Block] = [
        paragraph(
            f"The input u (in {page.drive}) pushes cart 1; each effect adds a force f, or changes "
            "the input, under a letter of its own:"
        ),
        augmented_equations(springs, gap.model.terms),
    ]
    for index, term in enumerate(gap.model.terms):
        blocks += [
            paragraph(f"{_where_words(term)}:"),
            law(gap.model.terms, index),
        ]
    blocks.append(
        chain_table(
            gap.model.chain,
            std=gap.chain_std,
            number=page.table_number(),
            position_unit=page.position,
            input_unit=page.drive,
        )
    )
    scatter = [
        f"On cart {cart} the dry friction varies by {percent(100 * spread)} from run to run "
        "(one standard deviation, learnt from the runs)."
        for cart, spread in sorted(gap.spread.items())
    ]
    blocks += remarks(scatter)
    blocks.append(
        paragraph(
            "The file ",
            Span("gap.json", "code"),
            " holds this model; ",
            Span("cartlab simulate --model gap.json", "code"),
            " simulates it.",
        )
    )
    return blocks


def _where_words(term: Term) -> str:
    name = effect_name(term.effect, term.where)
    meaning = {
        "cart": f"x and v are position and velocity of {place_name(term.where)}",
        "spring": f"d is the stretch of {place_name(term.where)}, x on its right less x on its "
        "left",
        "input": "u on the right is the logged input",
    }[term.effect.place]
    return f"{name[:1].upper() + name[1:]} ({meaning})"


# ------------------------------------------------------------------ housekeeping


def _method(gap: Gap) -> list[Block]:
    blocks: list[Block] = [
        paragraph(
            "The linear chain was fitted to all training runs at once, so that wrong parameters "
            "are taken up and only missing structure is left. Every effect of the catalogue was "
            "then tried at every place; the best were fitted in full, together with the chain. "
            "An effect is believed only if it shrinks the error on runs that no fit has seen."
        ),
        bullet_list(
            spans(Span(lead, "strong"), clean(listing(list(runs))))
            for lead, runs in (
                ("Runs fitted to: ", gap.training),
                ("Runs held out: ", gap.held_out),
            )
            if runs
        ),
    ]
    return blocks + remarks(list(gap.notes))


def _provenance(page: Page, gap: Gap) -> list[Block]:
    files = file_table(page.analysis, number=page.table_number())
    return [
        paragraph(
            f"Made by cartlab {__version__}. The same input gives the same report"
            + ("." if gap.complete else ", but for a search that the time allowed has ended.")
        ),
        Details(spans(count(len(page.analysis.files), "data file")), (files,)),
    ]


def _worst_first(gap: Gap) -> list[Trace]:
    """Return the held-out runs, that of the largest error before first; one a run."""
    found: dict[str, Trace] = {}

    def size(trace: Trace) -> float:
        row = _row(gap, trace)
        return -(row.baseline if row else 0.0)

    for trace in sorted((t for t in gap.traces if t.held_out), key=size):
        found.setdefault(trace.experiment, trace)
    return list(found.values())


def _row(gap: Gap, trace: Trace) -> RecordGap | None:
    of_trace = (trace.experiment, trace.cart, trace.held_out)
    return next((r for r in gap.by_record if (r.experiment, r.cart, r.held_out) == of_trace), None)
