"""Sections on the measurements: frequency response, decays, steps, sine dwells."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.estimation.record_fit import record_fits
from pipeline.identify.model_checks import name_law
from pipeline.names import mode_suffixes, omega_names
from pipeline.report.builder import Page, left_out
from pipeline.report.document import Block, Details, Table, cell, paragraph
from pipeline.report.figures import CARTS
from pipeline.report.figures.bode import bode_figure, overview_figure
from pipeline.report.figures.time import (
    Motion,
    damping_figure,
    decay_figure,
    sine_figure,
    step_figure,
    sweep_figure,
)
from pipeline.results import ExperimentKind, FrequencyResponse
from pipeline.words.numbers import (
    count,
    join_names,
    listing,
    percent,
    significant,
    with_error,
)
from pipeline.words.phrases import phrases
from pipeline.words.text import clean, spans

_WORDS = phrases("measurements")
_MANY = 900.0  # percent; above this, the caption states the ratio
_MOST_PANELS = 6  # most repeats drawn in one figure; the tables have all repeats


# ----------------------------------------------------------- frequency response


def response_blocks(page: Page) -> list[Block]:
    """Return a Bode figure for every cart, the last cart first, as in the paper."""
    responses, chain = page.analysis.frequency_responses, page.analysis.chain
    key, pictures = "bode" if chain else "bode_points", []
    for response in sorted(responses, key=lambda r: -r.cart):
        if response.has_signal.any():
            figure = bode_figure(response, chain=chain, units=page.units)
            name, values = f"bode-cart-{response.cart}", _bode_words(page, response)
            pictures.append(page.picture(name, figure, _WORDS, key, alt="bode_alt", **values))
    if not pictures:
        return []
    found = {response.source for response in responses}
    sources = [
        _WORDS.text(f"source_{source}", kinds=_kinds(page))
        for source in ("dwells", "table", "records")
        if source in found
    ]
    return [paragraph(_WORDS.text("source", sources=listing(sources))), *pictures]


def _kinds(page: Page) -> str:
    """Return the kinds of recordings from which a response was computed, in words."""
    runs = {run for r in page.analysis.frequency_responses for run in r.experiments}
    kinds = {page.records[run].kind for run in runs if run in page.records}
    return listing([_WORDS.text(f"of_{kind}") for kind in ("step", "sweep") if kind in kinds])


def overview_blocks(page: Page) -> list[Block]:
    """Return one picture of the identification: all carts, measured and fitted."""
    shown = [r for r in page.analysis.frequency_responses if np.any(r.magnitude > 0)]
    if not shown:
        return []
    chain, marks = page.analysis.chain, listing(omega_names(mode_suffixes(page.analysis.bench.n)))
    figure = overview_figure(shown, chain=chain, units=page.units)
    key, values = "overview" if chain else "overview_points", {"carts": count(len(shown), "cart")}
    return [
        page.picture("overview", figure, _WORDS, key, alt="overview_alt", marks=marks, **values)
    ]


def _bode_words(page: Page, response: FrequencyResponse) -> dict[str, object]:
    """Return values for the caption: range of the points, quality of the fit, largest error.

    Points without a signal are only counted.
    """
    chain, n, cart = page.analysis.chain, page.analysis.bench.n, response.cart
    clear = response.has_signal
    omega, magnitude = response.omega[clear], response.magnitude[clear]
    faint = response.omega.size - omega.size
    peak = int(np.argmax(magnitude))
    numbers = {"first": omega[0], "last": omega[-1], "peak": omega[peak]}
    numbers["magnitude"] = magnitude[peak]
    ordinal = {1: "first", 2: "second", 3: "third"}.get(cart, f"{cart}th")
    values: dict[str, object] = {
        **{name: significant(float(value), digits=3) for name, value in numbers.items()},
        "cart": _WORDS.text("of_carts" if n > 1 else "one_cart", cart=cart, ordinal=ordinal),
        "number": cart,
        "points": omega.size,
        "unit": page.units.gain,
        "fitted": "",
        "faint": _WORDS.text("bode_faint", points=count(faint, "point")) if faint else "",
        "marks": listing(omega_names(mode_suffixes(n))),
    }
    if chain is None:
        return values
    off = 100 * (magnitude / np.abs(chain.frequency_response(omega)[cart - 1]) - 1)
    middle = percent(float(np.median(np.abs(off))))
    worst = int(np.argmax(np.abs(off)))
    return values | {
        "fitted": _WORDS.text("bode_alt_fitted", middle=middle),
        "half": significant(float(np.median(np.abs(off))), digits=2),
        "omega": significant(float(omega[worst]), digits=3),
        "far": _WORDS.text(
            "times" if off[worst] > _MANY else "above" if off[worst] > 0 else "below",
            most=significant(float(abs(off[worst])), digits=2),
            times=significant(float(1 + off[worst] / 100), digits=2),
        ),
    }


# ----------------------------------------------------------------- time records


def decay_blocks(page: Page) -> list[Block]:
    """Return the table of decays, their figures, and damping over amplitude."""
    decays = page.analysis.log_decrements
    if not decays:
        return []
    blocks: list[Block] = [_decay_table(page)]
    for cart in sorted({decay.cart for decay in decays}):
        of_cart = [d for d in decays if d.cart == cart and d.experiment in page.records]
        drawn = of_cart[:_MOST_PANELS]
        if not drawn:
            continue
        records, first = [page.records[decay.experiment] for decay in drawn], drawn[0]
        others = sum(not d.law.is_exponential for d in drawn)
        said = {
            "cart": cart,
            "zeta": with_error(first.zeta, first.zeta_std),
            "run": clean(first.name),
            "freed": _WORDS.text("let_go" if records[0].kind == "decay" else "stepped"),
            "others": _WORDS.text("decay_others", others=others, decays=len(drawn))
            if others
            else "",
            "more": left_out(len(of_cart) - len(drawn)),
            "records": count(len(drawn), "record"),
            "swing": significant(float(np.ptp(first.peak_y)), digits=2),
            "unit": page.position,
        }
        figure = decay_figure(drawn, records=records, position_unit=page.position)
        blocks.append(page.picture(f"decay-cart-{cart}", figure, _WORDS, "decay", **said))
    # A decay with only one amplitude shows no change of damping.
    changing = [d for d in decays if not d.law.is_exponential]
    if changing := [d for d in changing if d.zeta_at_amplitude.shape[1] > 1]:
        figure = damping_figure(changing, position_unit=page.position)
        runs = join_names(list(dict.fromkeys(clean(d.name) for d in changing)))
        blocks.append(page.picture("damping", figure, _WORDS, "damping", runs=runs))
    return blocks


def _decay_table(page: Page) -> Table:
    """Return frequency and damping of every decay, by two methods, and the law that it follows."""
    rows = []
    for decay in page.analysis.log_decrements:
        law = name_law(decay, unit=page.position)
        verdict = cell(law, "good" if decay.law.is_exponential else "bad")
        estimates = (
            (decay.omega_n, decay.omega_n_std),
            (decay.zeta, decay.zeta_std),
            (decay.zeta_peaks, decay.zeta_peaks_std),
        )
        numbers = [with_error(*estimate) for estimate in estimates]
        extrema = str(decay.peak_t.size)
        rows.append((clean(decay.name), str(decay.cart), *numbers, extrema, verdict))
    return page.table(_WORDS, "decay_table", rows, "lcdddcl", position=page.position)


def step_blocks(page: Page) -> list[Block]:
    """Return the static gains, and the steps with the model's lines if it was fitted to them."""
    gains = page.analysis.step_gains
    blocks: list[Block] = [_step_table(page)] if gains else []
    fitted = _fitted_runs(page, "step")
    with_gains = [g.experiment for g in gains if g.experiment in page.records]
    runs = list(dict.fromkeys([*with_gains, *fitted]))
    if drawn := runs[:_MOST_PANELS]:
        models = _fitted_motions(page, [run for run in drawn if run in fitted])
        figure = step_figure(
            [[g for g in gains if g.experiment == run] for run in drawn],
            records=[page.records[run] for run in drawn],
            position_unit=page.position,
            models=models,
        )
        carts = zip(range(1, page.analysis.bench.n + 1), CARTS, strict=False)
        styles = " ".join(f"{mark.capitalize()}: cart {cart}." for cart, (*_, mark) in carts)
        said = {
            "what": _WORDS.text("steps_fitted", left=_left(page, models)) if models else styles,
            "levels": _WORDS.text("steps_levels") if with_gains else "",
            "more": left_out(len(runs) - len(drawn)),
            "records": count(len(drawn), "record"),
        }
        blocks.append(page.picture("steps", figure, _WORDS, "steps", **said))
    return blocks


def sweep_blocks(page: Page) -> list[Block]:
    """Return the sweep that the model fitted to it explains worst."""
    runs = _fitted_runs(page, "sweep")
    motions = _fitted_motions(page, runs)
    if not motions:
        return []
    worst = max(motions, key=lambda run: max(_shares_left(page, run, motions[run])))
    figure = sweep_figure(page.records[worst], model=motions[worst], position_unit=page.position)
    said = {
        "run": clean(worst),
        "left": _left(page, {worst: motions[worst]}),
        "worst": _WORDS.text("sweep_worst", sweeps=count(len(runs), "sweep"))
        if len(runs) > 1
        else "",
        "carts": count(len(motions[worst]), "cart"),
    }
    return [page.picture("sweep", figure, _WORDS, "sweep", **said)]


def _fitted_runs(page: Page, kind: ExperimentKind) -> list[str]:
    """Return the recordings of a kind to which the model was fitted in the time domain."""
    fit = page.analysis.fit
    if page.analysis.chain is None or fit is None or fit.method != "time_fit":
        return []
    records = (page.records[run] for run in fit.experiments if run in page.records)
    return [record.id for record in records if record.kind == kind]


def _fitted_motions(page: Page, runs: Sequence[str]) -> dict[str, Motion]:
    """Return the model's motion in recordings; start and encoder zeros are fitted to each."""
    chain = page.analysis.chain
    if chain is None:
        return {}
    records = [page.records[run] for run in runs]
    return {
        run: {
            cart: page.records[run].position(cart) + residual
            for cart, residual in fit.residual.items()
        }
        for run, fit in record_fits(records, chain).items()
    }


def _shares_left(page: Page, run: str, model: Motion) -> list[float]:
    """Return what the model leaves of each cart's motion in a recording (rms, percent)."""
    return [
        100 * float(np.std(page.records[run].position(cart) - y))
        / float(np.std(page.records[run].position(cart)))
        for cart, y in model.items()
    ]  # fmt: skip


def _left(page: Page, models: Mapping[str, Motion]) -> str:
    """Return the range of what the model leaves of the motion: "0.4 %", "1.2 to 3.5 %"."""
    shares = [share for run, model in models.items() for share in _shares_left(page, run, model)]
    low, high = (significant(share, digits=2) for share in (min(shares), max(shares)))
    return f"{high} %" if low == high else f"{low} to {high} %"


def _step_table(page: Page) -> Table:
    """Return the static gain of every step recording and cart."""
    rows = []
    for gain in page.analysis.step_gains:
        value = with_error(gain.gain, gain.gain_std)
        if gain.interval is not None:
            value = " to ".join(significant(v, digits=3) for v in gain.interval)
        edges, shift = str(len(gain.edges)), significant(gain.rest_shift, digits=2)
        rows.append((clean(gain.experiment), str(gain.cart), edges, value, shift))
    units = {"gain": page.units.gain, "position": page.position}
    return page.table(_WORDS, "step_table", rows, "lccdd", **units)


def dwell_blocks(page: Page) -> list[Block]:
    """Return one dwell with its transient and steady state, and the numbers of all dwells."""
    points = [p for p in page.analysis.sine_points if p.experiment in page.records]
    if not points:
        return []
    # Show the settled dwell nearest to 4 Hz, the frequency of the paper's Figures 12-14.
    paper = 2 * np.pi * 4.0
    chosen = min(points, key=lambda p: (not p.settled, abs(float(np.log(p.omega / paper)))))
    shown = sorted((p for p in points if p.experiment == chosen.experiment), key=lambda p: p.cart)
    figure = sine_figure(shown, record=page.records[chosen.experiment], position_unit=page.position)
    ratios = [f"cart {p.cart}: {with_error(p.gain, p.gain_std)}" for p in shown]
    amplitudes = [f"{significant(p.amplitude, digits=3)} {page.position}" for p in shown]
    said = {
        "hertz": significant(chosen.omega / (2 * np.pi), digits=3),
        "seconds": significant(max(p.steady_from for p in shown), digits=3),
        "carts": "every cart" if len(shown) > 1 else "the cart",
        "run": clean(chosen.experiment),
        "amplitudes": listing(amplitudes),
        "unit": page.units.gain,
        "ratios": "; ".join(ratios),
        "dwells": count(len({p.experiment for p in page.analysis.sine_points}), "dwell"),
    }
    return [
        paragraph(_WORDS.text("dwell", **said)),
        page.picture("sine", figure, _WORDS, "sine", **said),
        Details(spans(_WORDS.text("all_dwells", **said)), (dwell_table(page),)),
    ]


def dwell_table(page: Page) -> Table:
    """Return frequency, amplitudes, ratio, phase and settling of every dwell and cart."""
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
    units = {"drive": page.drive, "position": page.position, "gain": page.units.gain}
    return page.table(_WORDS, "dwell_table", rows, "ldcddddr", **units)
