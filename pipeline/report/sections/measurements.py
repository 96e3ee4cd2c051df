"""Sections on the measurements: frequency response, decays, steps, sine dwells."""

import numpy as np

from pipeline.names import mode_suffixes, omega_names
from pipeline.report.document import Block, Details, Table, cell, paragraph, spans
from pipeline.report.figures.bode import bode_figure, overview_figure
from pipeline.report.figures.style import CART_MARKS
from pipeline.report.figures.time import damping_figure, decay_figure, sine_figure, step_figure
from pipeline.report.numbers import count, listing, percent, significant, with_error
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page, left_out
from pipeline.report.words import clean, name_span
from pipeline.results import FrequencyResponse, SinePoint

_WORDS = phrases("measurements")
_TABLES = phrases("report")
_MOST_PANELS = 6  # repeats drawn in one figure; the tables hold all
_PAPER_DWELL = 2 * np.pi * 4.0  # rad/s: the 4 Hz of the paper's Figures 12-14
_ORDINALS = {1: "first", 2: "second", 3: "third", 4: "fourth"}


# ----------------------------------------------------------- frequency response


def response_blocks(page: Page) -> list[Block]:
    """Return a Bode figure for every cart, last cart first as the paper shows them."""
    chain = page.analysis.chain
    blocks: list[Block] = []
    for response in sorted(page.analysis.frequency_responses, key=lambda r: -r.cart):
        if np.any(response.magnitude > 0):
            figure = bode_figure(
                response, chain=chain, position_unit=page.position, input_unit=page.drive
            )
            caption, alt = _bode_caption(page, response), _bode_alt(page, response)
            blocks.append(
                page.picture(f"bode-cart-{response.cart}", figure, caption=caption, alt=alt)
            )
    if not blocks:
        return []
    found = {response.source for response in page.analysis.frequency_responses}
    said = {"source_dwells": {}, "source_table": {}, "source_records": {"kinds": _kinds(page)}}
    used = [
        _WORDS.text(key, **values)
        for key, values in said.items()
        if key.removeprefix("source_") in found
    ]
    return [paragraph(_WORDS.text("source", sources=listing(used))), *blocks]


def _kinds(page: Page) -> str:
    """Return of which kinds the records are that a response was taken from."""
    runs = {run for r in page.analysis.frequency_responses for run in r.experiments}
    kinds = {page.records[run].kind for run in runs if run in page.records}
    return listing([_WORDS.text(f"of_{kind}") for kind in ("step", "sweep") if kind in kinds])


def overview_blocks(page: Page) -> list[Block]:
    """Return one picture of what was identified: all carts, measured and fitted."""
    shown = [r for r in page.analysis.frequency_responses if np.any(r.magnitude > 0)]
    if not shown:
        return []
    chain, marks = page.analysis.chain, listing(omega_names(mode_suffixes(page.analysis.carts)))
    figure = overview_figure(shown, chain=chain, position_unit=page.position, input_unit=page.drive)
    key = "overview" if chain else "overview_points"
    alt = _WORDS.text("overview_alt", carts=count(len(shown), "cart"))
    return [page.picture("overview", figure, caption=_WORDS.text(key, marks=marks), alt=alt)]


def _bode_caption(page: Page, response: FrequencyResponse) -> str:
    """Say how near the fit is, and where it is farthest off."""
    chain, n, cart = page.analysis.chain, page.analysis.carts, response.cart
    ordinal = _ORDINALS.get(cart, f"{cart}th")
    name = _WORDS.text("of_carts" if n > 1 else "one_cart", cart=cart, ordinal=ordinal)
    if chain is None:
        return _WORDS.text("bode_points", cart=name)
    shown = response.magnitude > 0
    omega, measured = response.omega[shown], response.magnitude[shown]
    off = 100 * (measured / np.abs(chain.frequency_response(omega)[cart - 1]) - 1)
    worst = int(np.argmax(np.abs(off)))
    return _WORDS.text(
        "bode",
        cart=name,
        half=significant(float(np.median(np.abs(off))), digits=2),
        omega=significant(float(omega[worst]), digits=3),
        most=significant(float(abs(off[worst])), digits=2),
        side="above" if off[worst] > 0 else "below",
        marks=listing(omega_names(mode_suffixes(n))),
    )


def _bode_alt(page: Page, response: FrequencyResponse) -> str:
    omega, magnitude, fitted = response.omega, response.magnitude, ""
    if chain := page.analysis.chain:
        line = np.abs(chain.frequency_response(omega)[response.cart - 1])
        middle = float(np.median(np.abs(100 * (magnitude / line - 1))))
        fitted = _WORDS.text("bode_alt_fitted", middle=percent(middle))
    peak = int(np.argmax(magnitude))
    numbers = {"first": omega[0], "last": omega[-1], "peak": omega[peak]}
    numbers["magnitude"] = magnitude[peak]
    return _WORDS.text(
        "bode_alt",
        cart=response.cart,
        points=omega.size,
        unit=f"{page.position}/{page.drive}",
        fitted=fitted,
        **{name: significant(float(value), digits=3) for name, value in numbers.items()},
    )


# ----------------------------------------------------------------- time records


def decay_blocks(page: Page) -> list[Block]:
    """Return the table of decays, their figures, and damping against amplitude."""
    decays = page.analysis.log_decrements
    if not decays:
        return []
    blocks: list[Block] = [_decay_table(page)]
    for cart in sorted({decay.cart for decay in decays}):
        of_cart = [d for d in decays if d.cart == cart and d.experiment in page.records]
        drawn = of_cart[:_MOST_PANELS]
        if not drawn:
            continue
        records = [page.records[decay.experiment] for decay in drawn]
        figure = decay_figure(drawn, records=records, position_unit=page.position)
        first = drawn[0]
        sticks = [clean(d.name) for d in drawn if d.friction and d.friction.present]
        said = {"cart": str(cart), "zeta": with_error(first.zeta, first.zeta_std)}
        caption = _WORDS.text(
            "decay",
            run=clean(first.name),
            freed=_WORDS.text("let_go" if records[0].kind == "decay" else "stepped"),
            sticking=_WORDS.text("decay_sticking", sticking=listing(sticks)) if sticks else "",
            more=left_out(len(of_cart) - len(drawn)),
            **said,
        )
        alt = _WORDS.text(
            "decay_alt",
            records=count(len(drawn), "record"),
            swing=significant(float(np.ptp(first.peak_y)), digits=2),
            unit=page.position,
            **said,
        )
        blocks.append(page.picture(f"decay-cart-{cart}", figure, caption=caption, alt=alt))
    rubbing = [d for d in decays if d.friction and d.friction.present]
    if rubbing := [d for d in rubbing if d.zeta_at_amplitude.shape[1] > 1]:  # one is no rise
        figure = damping_figure(rubbing, position_unit=page.position)
        runs = listing(list(dict.fromkeys(clean(d.name) for d in rubbing)))
        caption, alt = _WORDS.text("damping", runs=runs), _WORDS.text("damping_alt")
        blocks.append(page.picture("damping", figure, caption=caption, alt=alt))
    return blocks


def _decay_table(page: Page) -> Table:
    """Return frequency and damping of every decay, by both methods, with the friction test."""
    rows = []
    for decay in page.analysis.log_decrements:
        friction = decay.friction
        if friction is None:
            verdict = cell("not tested", "quiet")
        elif friction.present:
            verdict = cell(with_error(friction.drop, friction.drop_std), "bad")
        else:
            verdict = cell("none seen", "good")
        rows.append(
            (
                clean(decay.name),
                str(decay.cart),
                with_error(decay.omega_n, decay.omega_n_std),
                with_error(decay.zeta, decay.zeta_std),
                with_error(decay.zeta_peaks, decay.zeta_peaks_std),
                str(decay.peak_t.size),
                verdict,
            )
        )
    zeta = name_span("zeta")
    return page.table(
        _TABLES.text("decay_table"),
        ("Record", "Cart", spans(name_span("omega_n"), " [rad/s]"), spans(zeta, " of the fit"),
         spans(zeta, " of the extrema"), "Extrema", f"Dry friction d [{page.position}]"),
        rows,
        "lcdddcr",
    )  # fmt: skip


def step_blocks(page: Page) -> list[Block]:
    """Return the static gains and the step responses they were read from."""
    gains = page.analysis.step_gains
    if not gains:
        return []
    blocks: list[Block] = [_step_table(page)]
    runs = list(dict.fromkeys(g.experiment for g in gains if g.experiment in page.records))
    if drawn := runs[:_MOST_PANELS]:
        figure = step_figure(
            [[g for g in gains if g.experiment == run] for run in drawn],
            records=[page.records[run] for run in drawn],
            position_unit=page.position,
        )
        caption = _WORDS.text(
            "steps", styles=_marks(page.analysis.carts), more=left_out(len(runs) - len(drawn))
        )
        alt = _WORDS.text("steps_alt", records=count(len(drawn), "record"))
        blocks.append(page.picture("steps", figure, caption=caption, alt=alt))
    return blocks


def _step_table(page: Page) -> Table:
    """Return the static gain of every step record and cart."""
    rows = []
    for gain in page.analysis.step_gains:
        value = with_error(gain.gain, gain.gain_std)
        if gain.interval is not None:
            value = " to ".join(significant(v, digits=3) for v in gain.interval)
        edges, shift = str(len(gain.edges)), significant(gain.rest_shift, digits=2)
        rows.append((clean(gain.experiment), str(gain.cart), edges, value, shift))
    unit, moved = f"K [{page.position}/{page.drive}]", f"Rest moved by [{page.position}]"
    return page.table(
        _TABLES.text("step_table"), ("Record", "Cart", "Edges", unit, moved), rows, "lccdd"
    )


def _marks(carts: int) -> str:
    marks = zip(range(1, carts + 1), CART_MARKS.values(), strict=False)
    return ", ".join(f"cart {cart} {mark}" for cart, mark in marks).capitalize()


def dwell_blocks(page: Page) -> list[Block]:
    """Return one dwell, the transient told from the steady state, and the numbers of all."""
    points = [p for p in page.analysis.sine_points if p.experiment in page.records]
    if not points:
        return []
    chosen = min(points, key=_instructive)
    shown = sorted((p for p in points if p.experiment == chosen.experiment), key=lambda p: p.cart)
    figure = sine_figure(shown, record=page.records[chosen.experiment], position_unit=page.position)
    ratios = [f"cart {p.cart}: {with_error(p.gain, p.gain_std)}" for p in shown]
    amplitudes = [f"{significant(p.amplitude, digits=3)} {page.position}" for p in shown]
    said = {
        "hertz": significant(chosen.omega / (2 * np.pi), digits=3),
        "seconds": significant(chosen.steady_from, digits=3),
    }
    carts, run = "every cart" if len(shown) > 1 else "the cart", clean(chosen.experiment)
    unit = f"{page.position}/{page.drive}"
    return [
        paragraph(_WORDS.text("dwell", unit=unit, ratios="; ".join(ratios), **said)),
        page.picture(
            "sine",
            figure,
            caption=_WORDS.text("sine", run=run, carts=carts, **said),
            alt=_WORDS.text("sine_alt", amplitudes=listing(amplitudes), **said),
        ),
        _all_dwells(page),
    ]


def _all_dwells(page: Page) -> Block:
    dwells = count(len({point.experiment for point in page.analysis.sine_points}), "dwell")
    return Details(spans(_WORDS.text("all_dwells", dwells=dwells)), (dwell_table(page),))


def dwell_table(page: Page) -> Table:
    """Return frequency, amplitudes, ratio and phase of every dwell and cart; whether it settled."""
    position, drive = page.position, page.drive
    rows = [
        (
            clean(point.experiment),
            significant(point.omega / (2 * np.pi)),
            str(point.cart),
            significant(point.input_amplitude),
            with_error(point.amplitude, point.amplitude_std),
            with_error(point.gain, point.gain_std),
            with_error(np.degrees(point.phase), np.degrees(point.phase_std)),
            significant(point.steady_from, digits=3) if point.settled
            else cell("not settled", "bad"),
        )
        for point in sorted(
            page.analysis.sine_points, key=lambda p: (p.omega, p.experiment, p.cart)
        )
    ]  # fmt: skip
    head = (
        "Record", "f [Hz]", "Cart", f"|U| [{drive}]", f"|X| [{position}]",
        f"|X|/|U| [{position}/{drive}]", "Phase [°]", "Steady from [s]",
    )  # fmt: skip
    return page.table(_TABLES.text("dwell_table"), head, rows, "ldcddddr")


def _instructive(point: SinePoint) -> tuple[bool, float]:
    """Settled dwells first, then those nearest the paper's 4 Hz."""
    return not point.settled, abs(float(np.log(point.omega / _PAPER_DWELL)))
