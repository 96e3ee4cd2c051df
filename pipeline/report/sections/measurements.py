"""Sections on the measurements: frequency response, decays, steps, sine dwells."""

from collections.abc import Sequence

import numpy as np

from pipeline.names import mode_suffixes, omega_names
from pipeline.report.document import Block, paragraph
from pipeline.report.figures.bode import bode_figure
from pipeline.report.figures.time import damping_figure, decay_figure, sine_figure, step_figure
from pipeline.report.numbers import count, listing, percent, significant, with_error
from pipeline.report.sections.page import Page, left_out
from pipeline.report.tables import decay_table, step_table
from pipeline.report.words import clean
from pipeline.results import FrequencyResponse, LogDecrement, SinePoint

_MOST_PANELS = 6  # repeats drawn in one figure; the tables hold all
_PAPER_DWELL = 2 * np.pi * 4.0  # rad/s: the 4 Hz of the paper's Figures 12-14
_ORDINALS = {1: "first", 2: "second", 3: "third", 4: "fourth"}


# ----------------------------------------------------------- frequency response


def response_blocks(page: Page) -> list[Block]:
    """Return a Bode figure for every cart, last cart first as the paper shows them."""
    chain = page.analysis.chain
    blocks: list[Block] = []
    for response in sorted(page.analysis.frequency_responses, key=lambda r: -r.cart):
        if not np.any(response.magnitude > 0):
            continue
        figure = bode_figure(
            response, chain=chain, position_unit=page.position, input_unit=page.drive
        )
        caption = _bode_caption(page, response)
        blocks.append(
            page.picture(
                f"bode-cart-{response.cart}", figure, caption=caption, alt=_bode_alt(page, response)
            )
        )
    if not blocks:
        return []
    return [paragraph(_response_source(page.analysis.frequency_responses)), *blocks]


def _bode_caption(page: Page, response: FrequencyResponse) -> str:
    """Say how near the fit is, and where it is farthest off."""
    points = "the measured points (diamonds, with standard errors)"
    chain, n = page.analysis.chain, page.analysis.carts
    cart = f"X_{response.cart}/U, the {_ordinal(response.cart)} cart" if n > 1 else "X/U"
    if chain is None:
        return f"{cart}: {points}."
    shown = response.magnitude > 0
    omega, measured = response.omega[shown], response.magnitude[shown]
    off = 100 * (measured / np.abs(chain.frequency_response(omega)[response.cart - 1]) - 1)
    worst = int(np.argmax(np.abs(off)))
    marks = listing(omega_names(mode_suffixes(n)))
    half, most = (
        significant(float(v), digits=2) for v in (np.median(np.abs(off)), abs(off[worst]))
    )
    return (
        f"{cart}: half of {points} lie within {half} % of the fit (line); the farthest, at "
        f"{significant(float(omega[worst]), digits=3)} rad/s, lies {most} % "
        f"{'above' if off[worst] > 0 else 'below'} it. Dotted: {marks}."
    )


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


def _bode_alt(page: Page, response: FrequencyResponse) -> str:
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


def decay_blocks(page: Page) -> list[Block]:
    """Return the table of decays, their figures, and damping against amplitude."""
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
                caption=f"Cart {cart} let go: its swing (points) shrinks inside the fitted "
                f"envelope (dashed) with zeta = {with_error(drawn[0].zeta, drawn[0].zeta_std)} in "
                f"{clean(drawn[0].experiment)}.{_sticking(drawn)} Diamonds: the extrema used; time "
                f"counts from the release, before it is shaded.{left_out(len(own) - len(drawn))}",
                alt=f"Free decay of cart {cart} in {count(len(drawn), 'record')}: "
                f"the swing falls from {significant(float(np.ptp(drawn[0].peak_y)), digits=2)} "
                f"{page.position} peak to peak inside an envelope with damping ratio "
                f"{with_error(drawn[0].zeta, drawn[0].zeta_std)}.",
            )
        )
    rubbing = [d for d in decays if d.friction and d.friction.present and d.zeta_at_amplitude.size]
    if rubbing:
        blocks.append(
            page.picture(
                "damping",
                damping_figure(rubbing, position_unit=page.position),
                caption="The damping ratio rises as the swing falls, which is what dry friction "
                "does; viscous damping alone would give a level line. A marker for each record.",
                alt="Damping ratio against amplitude of the decays with dry friction, rising "
                "towards small amplitudes.",
            )
        )
    return blocks


def _sticking(decays: Sequence[LogDecrement]) -> str:
    if any(decay.friction and decay.friction.present for decay in decays):
        return " Its last swings die sooner than the envelope says: dry friction."
    return ""


def step_blocks(page: Page) -> list[Block]:
    """Return the static gains and the step responses they were read from."""
    gains = page.analysis.step_gains
    if not gains:
        return []
    units = (page.position, page.drive)
    blocks: list[Block] = [step_table(gains, number=page.table_number(), units=units)]
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
                caption="Between two levels (thick, over the windows they were read from) a cart "
                "moves by its static gain times the step. "
                f"{_line_styles(page.analysis.carts)}; dotted: edges of the input."
                f"{left_out(len(runs) - len(drawn))}",
                alt=f"Step responses in {count(len(drawn), 'record')}, with the rest and settled "
                "levels of every cart marked.",
            )
        )
    return blocks


def _line_styles(carts: int) -> str:
    styles = zip(range(1, carts + 1), ("solid", "dashed", "dash-dotted", "dotted"), strict=False)
    return ", ".join(f"cart {cart} {style}" for cart, style in styles).capitalize()


def dwell_blocks(page: Page) -> list[Block]:
    """Return one dwell, the transient told from the steady state."""
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
            caption=f"Driven by a {hertz} Hz sine ({clean(chosen.experiment)}), "
            f"{'every cart' if len(own) > 1 else 'the cart'} swings evenly, between the two lines, "
            f"only after {significant(chosen.steady_from, digits=3)} s; an amplitude read in the "
            "shaded transient would be wrong.",
            alt=f"Response to a {hertz} Hz sine: transient up to "
            f"{significant(chosen.steady_from, digits=3)} s, then a steady swing of "
            + listing([f"{significant(p.amplitude, digits=3)} {page.position}" for p in own])
            + " amplitude.",
        ),
    ]
    return blocks


def _instructive(point: SinePoint) -> tuple[bool, float]:
    """Settled dwells first, then those nearest the paper's 4 Hz."""
    return not point.settled, abs(float(np.log(point.omega / _PAPER_DWELL)))


def _ordinal(cart: int) -> str:
    return _ORDINALS.get(cart, f"{cart}th")
