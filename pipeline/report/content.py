"""What a report says, in order: an `Analysis` as a `Document`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count as counter

import numpy as np
from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.report.document import (
    Block,
    Document,
    Heading,
    Picture,
    Section,
    Span,
    bullet_list,
    paragraph,
    spans,
)
from pipeline.report.figures import WIDTH, drawing, to_svg
from pipeline.report.figures_bode import bode_figure
from pipeline.report.figures_time import (
    damping_figure,
    decay_figure,
    design_figure,
    hardware_figure,
    sine_figure,
    step_figure,
)
from pipeline.report.model import (
    equations_of_motion,
    numeric_state_space,
    numeric_transfer_functions,
    symbolic_state_space,
    symbolic_transfer_functions,
)
from pipeline.report.notes import note_blocks
from pipeline.report.numbers import count, listing, percent, significant, with_error
from pipeline.report.tables import (
    chain_table,
    check_table,
    decay_table,
    feedback_table,
    file_table,
    hardware_table,
    parameter_notes,
    parameter_table,
    pole_table,
    step_table,
)
from pipeline.report.words import clean, names_spans, rich, stage_name, summary
from pipeline.results import Analysis, FrequencyResponse, Record, SinePoint

_MOST_PANELS = 6  # repeats drawn in one figure; the tables hold all
_MOST_RUNS = 4  # closed-loop runs drawn
_PAPER_DWELL = 2 * np.pi * 4.0  # rad/s: the 4 Hz of the paper's Figures 12-14
_ORDINALS = {1: "first", 2: "second", 3: "third", 4: "fourth"}


@dataclass(frozen=True)
class _Page:
    """The analysis, its text made fit to show, and the running numbers of figures and tables."""

    analysis: Analysis
    records: dict[str, Record]
    position: str
    drive: str
    _figures: counter = field(default_factory=lambda: counter(1))
    _tables: counter = field(default_factory=lambda: counter(1))

    def table_number(self) -> int:
        return next(self._tables)

    def picture(self, name: str, figure: Figure, *, caption: str, alt: str) -> Picture:
        alt = clean(alt)
        return Picture(
            number=next(self._figures),
            name=name,
            caption=rich(clean(caption)),
            alt=alt,
            svg=to_svg(figure, name=name, alt=alt),
            width=WIDTH,
        )


def build_document(analysis: Analysis, *, progress: Callable[[str], None] | None) -> Document:
    """Return the report of an analysis; sections that have nothing to show are left out."""
    page = _Page(
        analysis=analysis,
        records={record.id: record for record in analysis.records},
        position=clean(analysis.position_unit),
        drive=clean(analysis.input_unit),
    )
    parts: Sequence[tuple[str, str, Callable[[_Page], list[Block]]]] = (
        ("summary", "Summary", lambda page: summary(page.analysis)),
        ("model", "The model", _model),
        ("parameters", "Initial and final estimates", _parameters),
        ("frequency-response", "Frequency response", _frequency_response),
        ("decays", "Free decays", _decays),
        ("steps", "Steps and static gains", _steps),
        ("steady-state", "Sinusoidal steady state", _steady_state),
        ("feedback", "State feedback", _feedback),
        ("hardware", "Model and measurement", _hardware),
        ("checks", "Consistency checks", _checks),
        ("discussion", "Discussion", _discussion),
        ("warnings", "Warnings", _warnings),
        ("skipped", "What was skipped", _skipped),
        ("provenance", "Provenance", _provenance),
    )
    sections = []
    with drawing():
        for id_, title, blocks_of in parts:
            if progress:
                progress(f"report: {title.lower()}")
            if blocks := blocks_of(page):
                sections.append(Section(id=id_, title=title, blocks=tuple(blocks)))
    section = f"Section {clean(analysis.section)} · " if analysis.section else ""
    return Document(
        title=clean(analysis.title).strip() or f"Identification of {count(analysis.carts, 'cart')}",
        subtitle=f"{section}Identification and control of {count(analysis.carts, 'cart')}",
        authors=tuple(clean(f"{name} ({id_})" if name else id_) for id_, name in analysis.authors),
        sections=tuple(sections),
        footer=f"cartlab {__version__}",
    )


# ----------------------------------------------------------------------- model


def _model(page: _Page) -> list[Block]:
    analysis = page.analysis
    blocks: list[Block] = [
        paragraph(
            f"The input u (in {page.drive}) pushes cart 1; x with its index is a cart's position "
            f"(in {page.position}), a dot is a derivative by time."
        ),
        equations_of_motion(analysis.springs),
        Heading(spans("State space")),
        symbolic_state_space(analysis.springs),
    ]
    chain = analysis.chain
    if chain:
        blocks += [paragraph("With the identified numbers, and the positions as outputs:")]
        blocks += numeric_state_space(chain)
    blocks.append(Heading(spans("Transfer functions")))
    if symbolic := symbolic_transfer_functions(analysis.springs):
        blocks.append(symbolic)
    if chain:
        blocks += [paragraph("With the identified numbers:"), numeric_transfer_functions(chain)]
    if analysis.fit:
        blocks.append(
            chain_table(
                analysis.fit,
                number=page.table_number(),
                position_unit=page.position,
                input_unit=page.drive,
            )
        )
    return blocks


def _parameters(page: _Page) -> list[Block]:
    rows = page.analysis.rows
    if not rows:
        return []
    blocks: list[Block] = [
        paragraph(
            "Initial estimates come from steps (gains), free decays of single carts, and the "
            "resonances seen in the frequency response; final estimates from the joint fit. The "
            "change in brackets is in combined standard errors (σ)."
        ),
        parameter_table(rows, number=page.table_number(), carts=page.analysis.carts),
    ]
    if remarks := parameter_notes(rows):
        blocks.append(bullet_list(remarks))
    if staged := _staged_differences(page):
        blocks.append(staged)
    return blocks


def _staged_differences(page: _Page) -> Block | None:
    """Say where the fit cart by cart ended up elsewhere than the joint fit."""
    fit = page.analysis.fit
    if fit is None or not fit.staged:
        return None
    finals = {name: estimate.value for name, estimate in fit.parameters.items()}
    changes = {
        name: 100 * (value / finals[name] - 1)
        for name, value in fit.staged.items()
        if finals.get(name)
    }
    if not changes:
        return None
    worst = max(changes, key=lambda name: abs(changes[name]))
    return paragraph(
        "Fitting cart by cart, the last one first, and then all carts jointly gives the same "
        f"parameters within {percent(abs(changes[worst]))}; ",
        names_spans([worst]),
        " moved most. The joint fit is the one reported: no two of its numbers contradict.",
    )


# ----------------------------------------------------------- frequency response


def _frequency_response(page: _Page) -> list[Block]:
    chain = page.analysis.chain
    blocks: list[Block] = []
    for response in sorted(page.analysis.frequency_responses, key=lambda r: -r.cart):
        figure = bode_figure(
            response, chain=chain, position_unit=page.position, input_unit=page.drive
        )
        modes = [f"omega_{m}" for m in "abcdefgh"[: page.analysis.carts]]
        marks = listing(modes if page.analysis.carts > 1 else ["omega_n"])
        caption = (
            f"Measured frequency response (diamonds, with standard errors) and estimated transfer "
            f"function (line) of the {_ordinal(response.cart)} cart, "
            f"X{response.cart}/U. Dotted: {marks}."
            if chain
            else f"Measured frequency response of the {_ordinal(response.cart)} cart."
        )
        blocks.append(
            page.picture(
                f"bode-cart-{response.cart}", figure, caption=caption, alt=_bode_alt(page, response)
            )
        )
    if not blocks:
        return []
    return [paragraph(_response_source(page.analysis.frequency_responses)), *blocks]


def _response_source(responses: Sequence[FrequencyResponse]) -> str:
    sources = {
        "dwells": "the steady amplitudes of the sine dwells",
        "table": "the table of amplitude ratios that was handed in, which has no phase",
        "records": "transforms of the step and sweep records, there being no dwells",
    }
    used = [text for key, text in sources.items() if any(r.source == key for r in responses)]
    return (
        f"Measured points come from {listing(used)}. The residual is measured over fitted "
        "magnitude, less one."
    )


def _bode_alt(page: _Page, response: FrequencyResponse) -> str:
    peak = int(np.argmax(response.magnitude))
    text = (
        f"Bode plot of cart {response.cart}: {response.omega.size} measured points from "
        f"{significant(float(response.omega[0]), digits=3)} to "
        f"{significant(float(response.omega[-1]), digits=3)} rad/s, largest at "
        f"{significant(float(response.omega[peak]), digits=3)} rad/s with "
        f"{significant(float(response.magnitude[peak]), digits=3)} {page.position}/{page.drive}"
    )
    if chain := page.analysis.chain:
        fitted = np.abs(chain.frequency_response(response.omega)[response.cart - 1])
        middle = float(np.median(np.abs(100 * (response.magnitude / fitted - 1))))
        text += f"; the fitted line differs by {percent(middle)} in the median"
    return text + "."


# ----------------------------------------------------------------- time records


def _decays(page: _Page) -> list[Block]:
    decays = page.analysis.log_decrements
    if not decays:
        return []
    blocks: list[Block] = [
        decay_table(decays, number=page.table_number(), position_unit=page.position)
    ]
    for cart in sorted({decay.cart for decay in decays}):
        own = [decay for decay in decays if decay.cart == cart and decay.experiment in page.records]
        drawn = own[:_MOST_PANELS]
        if not drawn:
            continue
        records = [page.records[decay.experiment] for decay in drawn]
        figure = decay_figure(drawn, records=records, position_unit=page.position)
        blocks.append(
            page.picture(
                f"decay-cart-{cart}",
                figure,
                caption=f"Free decay of cart {cart}: measured points, the extrema used "
                f"(diamonds), the fitted decay and its envelope (dashed); what lies before the "
                f"release is shaded.{_left_out(len(own) - len(drawn))}",
                alt=f"Free decay of cart {cart} in {count(len(drawn), 'record')}: "
                f"the swing falls from {significant(float(np.ptp(drawn[0].peak_y)), digits=2)} "
                f"{page.position} peak to peak inside an envelope with damping ratio "
                f"{with_error(drawn[0].zeta, drawn[0].zeta_std)}.",
            )
        )
        rubbing = [d for d in own if d.friction and d.friction.present and d.zeta_at_amplitude.size]
        if rubbing:
            figure = damping_figure(rubbing, position_unit=page.position)
            blocks.append(
                page.picture(
                    f"damping-cart-{cart}",
                    figure,
                    caption=f"Local damping ratio of cart {cart} against amplitude. Viscous "
                    "damping alone gives a level line; dry friction makes it rise as the "
                    "amplitude falls.",
                    alt=f"Damping ratio of cart {cart} against amplitude, rising towards small "
                    "amplitudes.",
                )
            )
    notes = [f"{d.experiment}, cart {d.cart}: {d.note}" for d in decays if d.note]
    return [*blocks, *_remarks(notes)]


def _steps(page: _Page) -> list[Block]:
    gains = page.analysis.step_gains
    if not gains:
        return []
    unit = f"{page.position}/{page.drive}"
    blocks: list[Block] = [step_table(gains, number=page.table_number(), unit=unit)]
    runs = list(dict.fromkeys(g.experiment for g in gains if g.experiment in page.records))
    if drawn := runs[:_MOST_PANELS]:
        figure = step_figure(
            [[g for g in gains if g.experiment == run] for run in drawn],
            records=[page.records[run] for run in drawn],
            position_unit=page.position,
        )
        blocks.append(
            page.picture(
                "steps",
                figure,
                caption="Step responses. Thick: the levels that were read off, over the windows "
                f"they were read from; dotted: edges of the input.{_left_out(len(runs) - len(drawn))}",
                alt=f"Step responses in {count(len(drawn), 'record')}, with the rest and settled "
                "levels of every cart marked.",
            )
        )
    notes = [f"{g.experiment}, cart {g.cart}: {g.note}" for g in gains if g.note]
    return [*blocks, *_remarks(notes)]


def _steady_state(page: _Page) -> list[Block]:
    points = [p for p in page.analysis.sine_points if p.experiment in page.records]
    if not points:
        return []
    chosen = min(points, key=_instructive)
    own = sorted((p for p in points if p.experiment == chosen.experiment), key=lambda p: p.cart)
    hertz = significant(chosen.omega / (2 * np.pi), digits=3)
    figure = sine_figure(own, record=page.records[chosen.experiment], position_unit=page.position)
    ratios = [f"cart {p.cart}: {with_error(p.gain, p.gain_std)}" for p in own]
    unit = f"{page.position}/{page.drive}"
    blocks: list[Block] = [
        paragraph(
            "Only the steady part counts for the frequency response: the transient, shaded, "
            "still holds the free motion that the start of the sine set off. "
            f"Amplitude ratios at {hertz} Hz in {unit}: {'; '.join(ratios)}."
        ),
        page.picture(
            "sine",
            figure,
            caption=f"Motion of {'every cart' if len(own) > 1 else 'the cart'} when the system is "
            f"excited by a {hertz} Hz sine wave ({chosen.experiment}): transient shaded, steady "
            "amplitude as a pair of lines.",
            alt=f"Response to a {hertz} Hz sine: transient up to "
            f"{significant(chosen.steady_from, digits=3)} s, then a steady swing of "
            + listing([f"{significant(p.amplitude, digits=3)} {page.position}" for p in own])
            + " amplitude.",
        ),
    ]
    notes = [
        f"{p.experiment}, cart {p.cart}: {p.note}" for p in page.analysis.sine_points if p.note
    ]
    return [*blocks, *_remarks(notes)]


def _instructive(point: SinePoint) -> tuple[bool, float]:
    """Settled dwells first, then those nearest the paper's 4 Hz."""
    return not point.settled, abs(float(np.log(point.omega / _PAPER_DWELL)))


# --------------------------------------------------------------------- control


def _feedback(page: _Page) -> list[Block]:
    design = page.analysis.feedback
    if design is None:
        return []
    method = {"lqr": "a linear quadratic regulator", "poles": "pole placement"}[design.method]
    goal = f"{significant(design.reference)} {page.position}"
    return [
        paragraph(
            f"Designed by {method}, with the controller's sampling and one sample of delay in the "
            f"model. {clean(design.message)}"
        ),
        feedback_table(design, number=page.table_number(), units=(page.position, page.drive)),
        pole_table(design, number=page.table_number()),
        page.picture(
            "feedback",
            design_figure(design, position_unit=page.position, input_unit=page.drive),
            caption=f"Simulated step of {goal} with the designed feedback: positions (cart "
            f"{design.cart} thick, its 2 % band shaded, dotted where it has settled) and input.",
            alt=f"Simulated step response: cart {design.cart} reaches {goal} with "
            f"{percent(design.overshoot_percent)} overshoot; the input peaks at "
            f"{significant(design.peak_input, digits=3)} {page.drive}.",
        ),
    ]


def _hardware(page: _Page) -> list[Block]:
    checks = page.analysis.hardware
    if not checks:
        return []
    table = hardware_table(checks, number=page.table_number(), position_unit=page.position)
    blocks: list[Block] = [table]
    runs = list(dict.fromkeys(check.experiment for check in checks))
    for i, run in enumerate(runs[:_MOST_RUNS], start=1):
        own = [check for check in checks if check.experiment == run]
        carts = sorted({check.cart for check in own})
        figure = hardware_figure(
            [[check for check in own if check.cart == cart] for cart in carts],
            position_unit=page.position,
        )
        worst = max(own, key=lambda check: check.nrmse)
        blocks.append(
            page.picture(
                f"hardware-{i}",
                figure,
                caption=f"Response of the real system (points) and of the model (line) in {run}, "
                f"cart by cart.{_left_out(len(runs) - _MOST_RUNS) if i == _MOST_RUNS else ''}",
                alt=f"Measured and modelled motion of {count(len(carts), 'cart')} in {run}; the "
                f"largest difference is {percent(100 * worst.nrmse)} of the motion, at cart "
                f"{worst.cart}.",
            )
        )
    scales = [
        f"{c.experiment}: the logged input explains the motion best when multiplied by "
        f"{significant(c.input_scale, digits=3)}"
        for c in checks
        if c.input_scale is not None and abs(c.input_scale - 1) > 0.05
    ]
    notes = [f"{c.experiment}, cart {c.cart}: {c.note}" for c in checks if c.note]
    return [*blocks, *_remarks(list(dict.fromkeys(scales)) + notes)]


# ----------------------------------------------------------------- housekeeping


def _checks(page: _Page) -> list[Block]:
    checks = page.analysis.checks
    return [check_table(checks, number=page.table_number())] if checks else []


def _discussion(page: _Page) -> list[Block]:
    return list(note_blocks(page.analysis.discussion or ""))


def _warnings(page: _Page) -> list[Block]:
    return _remarks(list(page.analysis.warnings))


def _skipped(page: _Page) -> list[Block]:
    skipped = page.analysis.skipped
    if not skipped:
        return []
    return [
        bullet_list(
            spans(Span(f"{stage_name(skip.stage)}: ", "strong"), rich(clean(skip.reason)))
            for skip in skipped
        )
    ]


def _provenance(page: _Page) -> list[Block]:
    made = paragraph(f"Made by cartlab {__version__}. The same input gives the same report.")
    if not page.analysis.files:
        return [made]
    return [made, file_table(page.analysis, number=page.table_number())]


def _remarks(notes: Sequence[str]) -> list[Block]:
    return [bullet_list(rich(clean(note)) for note in notes)] if notes else []


def _left_out(n: int) -> str:
    return f" {count(n, 'further record')} not drawn." if n > 0 else ""


def _ordinal(cart: int) -> str:
    return _ORDINALS.get(cart, f"{cart}th")
