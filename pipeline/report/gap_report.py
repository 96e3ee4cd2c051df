"""The sections on the gap: on a page of their own, and in the report of the same data."""

from collections.abc import Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.arrays import Array
from pipeline.estimation.force_balance import without_releases
from pipeline.gap.advice import MOST_NAMES, differences, disputed, proposed_recording, side_names
from pipeline.gap.replay import Replay, replay_driven
from pipeline.gap.residual import ResidualForce, residual_forces
from pipeline.gap.types import FoundEffect, Gap, GapWindow, RecordGap, Trace
from pipeline.plant.effect import effect_name, place_name
from pipeline.report.builder import Page, Part, left_out, remarks
from pipeline.report.document import (
    Block,
    Cell,
    Document,
    Table,
    Tone,
    bullet_list,
    cell,
    paragraph,
)
from pipeline.report.equations.model import augmented_equations, in_order, law
from pipeline.report.figures.gap import (
    band_shows,
    before_after_figure,
    by_record_figure,
    force_figure,
    force_left_figure,
    predicted_figure,
    spectrum_figure,
    timing_figure,
)
from pipeline.report.figures.style import (
    keep_in_sight,
    legend_above,
    name_panels,
    panels,
    plot_measured,
    plot_model,
    plot_second,
    position_label,
)
from pipeline.report.files import Made, make_files
from pipeline.report.gap_verdict import (
    WORDS,
    added_name,
    error_board,
    is_set_up_alone,
    kept_together,
    next_block,
    phase,
    scope_blocks,
    share,
    shares,
    verdict_blocks,
    verdict_title,
    whole_model,
)
from pipeline.report.sections.parameters import chain_table
from pipeline.results import Analysis, Intervention
from pipeline.words.numbers import count, listing, percent, unit_text, with_error
from pipeline.words.progress import Progress, silent
from pipeline.words.text import Spans, capital, clean, plain

_MOST_ROWS = 28  # most runs in the overview; gap.json has all runs
LEGEND = 46  # two names with more characters do not fit above a figure
_MORE_TRACES = 3  # traces drawn in addition to the one in the summary


def make_gap_files(
    gap: Gap, analysis: Analysis, *, pdf: bool = True, progress: Progress = silent
) -> Made:
    """Return `gap.html`, `figures/*.svg` and, if asked for, `gap.pdf`."""
    return make_files(build_gap_document(gap, analysis, progress=progress), name="gap", pdf=pdf)


def build_gap_document(gap: Gap, analysis: Analysis, *, progress: Progress = silent) -> Document:
    """Return the gap report; sections with nothing to show are left out."""
    page = Page(analysis)
    telling = _telling_first(gap)
    forces = residual_forces(gap, free={record.id: record.free for record in analysis.records})
    where = WORDS.text("where_enough" if gap.verdict == "none" else "where_fails")
    parts: list[Part] = [
        ("summary", verdict_title(gap), lambda page: _summary(page, gap, telling[:1])),
        ("where", where, lambda page: _where(page, gap)),
    ]
    for i, found in enumerate(gap.effects):
        name = effect_name(found.effect, found.where)
        title = name
        if gap.verdict == "unexplained" or gap.causes:
            title = WORDS.text("suspect", name=name)
        elif gap.verdict == "ambiguous" and found is disputed(gap)[0]:
            title = WORDS.text("one_explanation", name=name)
        parts.append(
            (
                f"effect-{i + 1}",
                capital(title),
                lambda page, i=i: _effect(page, gap, i, forces=forces),
            )
        )
    made = WORDS.text("made" if gap.complete else "made_so_far", version=__version__)
    parts += [
        ("runs", "Measured against simulated", lambda page: _runs(page, gap, telling[1:])),
        ("force-left", "The unexplained force", lambda page: _force_left(page, gap)),
        ("hands", WORDS.text("hands"), lambda page: _interventions(page, gap)),
        ("apart", "How to decide between the explanations", lambda page: _apart(page, gap)),
        ("model", capital(whole_model(gap)), lambda page: _model(page, gap)),
        ("method", "How this was found", lambda page: _method(gap)),
        ("warnings", "Remarks", lambda page: remarks(analysis.warnings)),
        ("provenance", "Provenance", lambda _: [paragraph(made)]),
    ]
    return page.document(
        page.sections(parts, doing="gap report", progress=progress),
        about="What the linear model leaves out",
    )


# --------------------------------------------------------------------- the page


def _summary(page: Page, gap: Gap, shown: Sequence[Trace]) -> list[Block]:
    pictures = [before_after_picture(page, gap, trace, number=1) for trace in shown]
    return _verdict(page, gap, shown=pictures)


def _verdict(page: Page, gap: Gap, *, shown: Sequence[Block]) -> list[Block]:
    """Return the verdict, its errors, what shows it, and what to do next."""
    blocks = [*verdict_blocks(gap), error_board(gap), error_table(page, gap), *shown]
    if gap.verdict == "none":
        blocks += scope_blocks(gap, position=page.position, drive=page.drive)
    return [*blocks, *next_block(gap)]


def _where(page: Page, gap: Gap) -> list[Block]:
    rows = sorted(gap.by_record, key=lambda row: (not row.held_out, -row.baseline))
    if not rows:
        return []
    shown = rows[:_MOST_ROWS]
    top, more = shown[0], left_out(len(rows) - len(shown))
    alone = "" if gap.effects else "_linear"
    values = {
        "more": more,
        "runs": count(len(shown), "recording"),
        "run": top.experiment,
        "cart": top.cart,
    }
    figure = by_record_figure(shown, added=added_name(gap))
    picture = page.picture("by-record", figure, WORDS, f"by_record{alone}", **values, **shares(top))
    blocks: list[Block] = [picture]
    if gap.where:
        blocks.append(window_table(page, gap.where, model=WORDS.text("linear_model")))
    return blocks


def before_after_picture(page: Page, gap: Gap, trace: Trace, *, number: int) -> Block:
    """Return a picture of one cart in one run: measurement, both models, and residuals."""
    row = _row(gap, trace)
    noise = 0.0
    if row is not None and row.final > 0:
        left = trace.measured - trace.final
        noise = row.noise_floor * (float((left**2).mean() ** 0.5) / row.final)
    alone = "" if gap.effects else "_linear"
    added = added_name(gap)
    figure = before_after_figure(
        trace,
        noise=noise,
        position_unit=page.position,
        added=added,
        touched=_touched(page, gap, trace),
    )
    said = {
        "cart": trace.cart,
        "run": trace.experiment,
        "held": WORDS.text("held_out" if trace.held_out else "used"),
        "errors": WORDS.text(f"run_errors{alone}", added=added_name(gap), **shares(row))
        if row
        else "",
        "model": whole_model(gap),
        "band": WORDS.text("band") if band_shows(trace, noise=noise, added=added) else "",
    }
    return page.picture(f"before-after-{number}", figure, WORDS, f"before_after{alone}", **said)


# ------------------------------------------------------------------- the effects


def _effect(page: Page, gap: Gap, index: int, *, forces: Sequence[ResidualForce]) -> list[Block]:
    found = gap.effects[index]
    effect = found.effect
    blocks: list[Block] = [
        paragraph(_step(gap, found)),
        law(gap.model.terms, index),
        *_evidence(page, gap, found, forces=forces, number=index + 1),
        effect_parameter_table(page, found),
    ]
    if found.rivals:
        blocks.append(rival_table(page, found, gap))
    facts = {
        "fingerprint": effect.fingerprint,
        "decides": effect.deciding_run,
        "equivalent": effect.equivalent,
        "read": effect.reference,
    }
    blocks.append(bullet_list(WORDS.spans(key, text=text) for key, text in facts.items() if text))
    return blocks


def _step(gap: Gap, found: FoundEffect) -> Spans:
    """Return a sentence on an effect, with the error before and after its group was added."""
    group = next(group for group in kept_together(gap.effects) if found in group)
    said = {
        "sentence": found.effect.sentence,
        "before": share(group[0].nrmse_before),
        "after": share(group[-1].nrmse_after),
    }
    if len(group) == 1:
        return WORDS.spans("step", **said)
    names = [effect_name(one.effect, one.where) for one in group]
    return WORDS.spans(
        "step_together",
        names=capital(listing(names)),
        count="both" if len(group) == 2 else "all",
        first=names[0],
        alone=share(group[0].nrmse_after),
        **said,
    )


def _evidence(
    page: Page, gap: Gap, found: FoundEffect, *, forces: Sequence[ResidualForce], number: int
) -> list[Block]:
    """Return the figure that shows an effect: force against its cause, timing, or spectrum."""
    axis, added = found.effect.axis, added_name(gap)
    if axis == "frequency":
        held_out = [trace for trace in gap.traces if trace.held_out]
        if not held_out:
            return []
        shown = "shown_frequency"
        figure = spectrum_figure(held_out, position_unit=page.position, added=added)
    elif axis == "time":
        shown, figure = "shown_time", timing_figure(forces, drive=page.drive, added=added)
    else:
        units = (page.position, page.drive)
        shown, figure = "shown_force", force_figure(found, forces, units=units, added=added)
    if figure is None:
        return []
    others = WORDS.text("others") if len(gap.effects) > 1 else ""
    said = {
        "name": effect_name(found.effect, found.where),
        "shown": WORDS.text(shown, others=others, model=whole_model(gap)),
        "axis": axis,
        "fingerprint": found.effect.fingerprint,
    }
    return [page.picture(f"effect-{number}", figure, WORDS, "evidence", **said)]


# --------------------------------------------------------------- runs and rivals


def _runs(page: Page, gap: Gap, shown: Sequence[Trace]) -> list[Block]:
    blocks = [
        before_after_picture(page, gap, trace, number=i)
        for i, trace in enumerate(shown[:_MORE_TRACES], start=2)
    ]
    if gap.left and gap.effects:
        blocks.append(window_table(page, gap.left, model=whole_model(gap)))
    return blocks


def _force_left(page: Page, gap: Gap) -> list[Block]:
    """Return, for each cart, the force that the model does not explain, with a formula for it."""
    if not gap.residual:
        return []
    model = whole_model(gap) if gap.effects else WORDS.text("linear_model")
    blocks: list[Block] = [paragraph(WORDS.spans("force_left", model=model))]
    for residual in gap.residual:
        cart = str(residual.cart)
        if residual.formula is None:
            sentence = WORDS.spans("force_left_no_formula", cart=cart)
        else:
            sentence = WORDS.spans(
                "force_left_formula",
                formula=residual.formula.text,
                unit=residual.unit,
                position=page.position,
                drive=page.drive,
                share=percent(100 * residual.formula.explains),
            )
        shown = {
            "cart": cart,
            "line": WORDS.text("force_left_formula_line") if residual.formula else "",
            "quantities": listing([shown.quantity for shown in residual.against]),
            "formula": plain(sentence),
        }
        figure, key = force_left_figure(residual), "force_left_figure"
        blocks += [
            page.picture(f"force-left-{cart}", figure, WORDS, key, **shown),
            paragraph(sentence),
        ]
    return blocks


def _interventions(page: Page, gap: Gap) -> list[Block]:
    hands = without_releases(gap.interventions, list(page.records.values()))
    return [intervention_table(page, hands)] if hands else []


def _touched(page: Page, gap: Gap, trace: Trace) -> list[tuple[Array, Array]]:
    """Return the recorded stretches, next to a run, in which a cart was moved by hand."""
    record = page.records.get(trace.experiment)
    if record is None:
        return []
    near = 2.0 * record.sample_time
    found = []
    for one in gap.interventions:
        before, after = trace.t[0] - one.end, one.start - trace.t[-1]
        if one.experiment == record.id and (0.0 <= before < near or 0.0 <= after < near):
            shown = (record.t >= one.start) & (record.t <= one.end)
            found.append((record.t[shown], record.position(trace.cart)[shown]))
    return found


def _apart(page: Page, gap: Gap) -> list[Block]:
    predicted = _predicted(page, gap)
    if gap.verdict != "ambiguous":
        return predicted
    experiment = "" if predicted else clean(gap.next_experiment)
    return [paragraph(WORDS.spans("apart", experiment=experiment)), *predicted]


def _predicted(page: Page, gap: Gap) -> list[Block]:
    """Return the proposed recording, and what each explanation predicts for it."""
    proposal = gap.proposal
    if proposal is None or proposal.prediction is None:
        return []
    prediction = proposal.prediction
    sides = differences(*(gap.contenders[i] for i in prediction.pair))
    if not sides[0]:
        sides = sides[::-1]
        prediction = replace(prediction, pair=prediction.pair[::-1])
    one, other = side_names(sides)
    names = one, other
    if len(one) + len(other) > LEGEND:
        names = WORDS.text("with_first"), WORDS.text("with_second")
        if not sides[1]:
            names = WORDS.text("with_these"), other
    figure = predicted_figure(prediction, names=names, position_unit=page.position)
    paragraph_ = WORDS.spans(
        "predicted",
        recording=proposed_recording(proposal.recording, drive=page.drive),
        separation=f"{proposal.separation:.2g}",
        one=one,
        other=other,
    )
    short = "; ".join(side_names(sides, most=MOST_NAMES))
    values = {"cart": prediction.cart, "names": short}
    picture = page.picture("predicted", figure, WORDS, "predicted_figure", **values)
    return [paragraph(paragraph_), picture]


# --------------------------------------------------------------------- the model


def _model(page: Page, gap: Gap) -> list[Block]:
    terms = gap.model.terms
    if not terms:
        return []
    blocks: list[Block] = [
        paragraph(WORDS.spans("model", drive=page.drive)),
        augmented_equations(page.analysis.bench.springs, terms),
    ]
    for index in in_order(terms):
        term = terms[index]
        name, place = effect_name(term.effect, term.where), place_name(term.where)
        where = WORDS.spans(f"where_{term.effect.place}", name=capital(name), place=place)
        blocks += [paragraph(where), law(terms, index)]
    table = chain_table(page, gap.model.chain, std=gap.chain_std)
    scatter = [
        WORDS.text("scatter", cart=cart, spread=percent(100 * spread))
        for cart, spread in sorted(gap.spread.items())
    ]
    return [*blocks, table, *remarks(scatter), paragraph(WORDS.spans("model_file"))]


# ------------------------------------------------------------------ housekeeping


def _method(gap: Gap) -> list[Block]:
    runs = bullet_list(
        WORDS.spans(key, runs=clean(listing(names)))
        for key, names in (("fitted_to", gap.training), ("runs_held_out", gap.held_out))
        if names
    )
    if gap.verdict == "none":
        method = WORDS.spans("method_none")
    elif is_set_up_alone(gap):
        method = WORDS.spans("method_linear")
    else:
        method = WORDS.spans("method" if gap.complete else "method_so_far")
    return [paragraph(method), runs, *remarks(list(gap.notes))]


def _telling_first(gap: Gap) -> list[Trace]:
    """Return one trace of each held-out run; the one in which the effects act most comes first.

    There, they lower the error most. Without effects, the trace with the largest error comes first.
    """

    def gain(trace: Trace) -> tuple[float, float]:
        row = _row(gap, trace)
        return (row.baseline - row.final, row.baseline) if row else (0.0, 0.0)

    # In ascending order, so that the most telling trace of each run is kept.
    held_out = sorted((trace for trace in gap.traces if trace.held_out), key=gain)
    telling = {trace.experiment: trace for trace in held_out}
    return sorted(telling.values(), key=gain, reverse=True)


def _row(gap: Gap, trace: Trace) -> RecordGap | None:
    of_trace = (trace.experiment, trace.cart, trace.held_out)
    return next((r for r in gap.by_record if (r.experiment, r.cart, r.held_out) == of_trace), None)


# ----------------------------------------------------------------------------- in the lab report


def gap_in_short(gap: Gap) -> list[Block]:
    """Return the verdict as one paragraph with a link to its section."""
    name = listing([effect_name(found.effect, found.where) for found in gap.effects])
    names = f" ({name})" if name and gap.verdict in ("named", "partial") and not gap.causes else ""
    sentence = WORDS.spans(
        "in_short" if gap.effects else "in_short_linear",
        verdict=f"{verdict_title(gap)}{names}",
        **shares(gap),
    )
    return [paragraph(sentence)]


def gap_blocks(page: Page, gap: Gap) -> list[Block]:
    """Return the verdict, the errors, and the equations with the effects."""
    terms, shown = gap.model.terms, []
    if terms:
        shown = [augmented_equations(page.analysis.bench.springs, terms)]
        shown += [law(terms, index) for index in in_order(terms)]
    return [*_verdict(page, gap, shown=shown), paragraph(WORDS.spans("story"))]


def augmented_hardware_blocks(page: Page, gap: Gap) -> list[Block]:
    """Return the model with effects next to the linear one, both driven by the measured input."""
    if not gap.model.terms:
        return []
    opened = [check for check in page.analysis.hardware if check.loop == "open"]
    runs = list(dict.fromkeys(check.experiment for check in opened))
    replays = {
        run: replay_driven(page.records[run], [c for c in opened if c.experiment == run], gap.model)
        for run in runs
        if run in page.records
    }
    every = [replay for found in replays.values() for replay in found]
    if not every:
        return []
    rows = [
        (clean(one.check.experiment), str(one.check.cart), share(one.check.nrmse), share(one.nrmse))
        for one in every
    ]
    added = added_name(gap)
    table = page.table(WORDS, "replay_table", rows, "lcdd", added=added, Added=capital(added))
    blocks: list[Block] = [paragraph(WORDS.spans("replay", added=added)), table]
    ordered = sorted(
        filter(None, replays.values()),
        key=lambda run: max(replay.nrmse for replay in run),
        reverse=True,
    )
    drawn = [ordered[0], *ordered[1:][-1:]]  # the worst and the best
    worst = max(drawn[0], key=lambda replay: replay.nrmse)
    values = {
        "run": worst.check.experiment,
        "error": share(worst.nrmse),
        "cart": worst.check.cart,
        "added": added,
        "others": WORDS.text(
            "replay_best", runs=len(ordered), run=drawn[-1][0].check.experiment, added=added
        )
        if len(drawn) > 1
        else "",
    }
    figure = _replay_figure(drawn, position_unit=page.position, added=added)
    return [*blocks, page.picture("hardware-effects", figure, WORDS, "replay_figure", **values)]


def _replay_figure(runs: Sequence[Sequence[Replay]], *, position_unit: str, added: str) -> Figure:
    """Return recordings side by side: each cart with both models."""
    carts = sorted({replay.check.cart for run in runs for replay in run})
    several = len(runs) > 1
    figure, axes = panels(*[1.05] * len(carts), columns=len(runs), share_x="column", titled=several)
    for column, run in enumerate(runs):
        own = axes[column :: len(runs)]
        for replay in run:
            check, ax = replay.check, own[carts.index(replay.check.cart)]
            plot_measured(ax, check.t, check.measured)
            plot_second(ax, check.t, check.model, label="linear model")
            plot_model(ax, check.t, replay.model, label=added)
            keep_in_sight(ax, check.measured)
        own[-1].set_xlabel("time [s]")
    for ax, cart in zip(axes[:: len(runs)], carts, strict=True):
        ax.set_ylabel(position_label(cart, position_unit))
    if several:
        names = [clean(run[0].check.experiment) for run in runs]
        name_panels(axes[: len(runs)], names, columns=len(runs))
    legend_above(axes[0])
    return figure


# ---------------------------------------------------------------------------------------- tables


def error_table(page: Page, gap: Gap) -> Table:
    """Return the error on held-out runs after each step, next to noise and repeatability.

    Effects that lower the error only together are one step.
    """
    models = [("linear model", gap.baseline)]
    for group in kept_together(gap.effects):
        names = listing([effect_name(found.effect, found.where) for found in group])
        models.append((f"with {names}", group[-1].nrmse_after))
    limits = [("noise alone", gap.noise_floor)]
    if gap.repeatability is not None:
        limits.append(("repeats of one recording differ by", gap.repeatability))
    rows = [[cell(name), cell(share(error))] for name, error in models]
    rows += [[cell(name, "quiet"), cell(share(error), "quiet")] for name, error in limits]
    return page.table(WORDS, "error_table", rows, "ld")


def window_table(page: Page, windows: Sequence[GapWindow], *, model: str) -> Table:
    """Return the stretches of time in which a model's error is largest.

    Parameters
    ----------
    model : name of the model, such as "the linear model".
    """
    rows = [(*_stretch(w), phase(w.what), percent(100 * w.share)) for w in windows]
    return page.table(WORDS, "window_table", rows, "lcddld", model=model)


def intervention_table(page: Page, interventions: Sequence[Intervention]) -> Table:
    """Return the stretches of time during which a cart was moved by hand."""
    rows = [(*_stretch(one), one.what) for one in interventions]
    return page.table(WORDS, "intervention_table", rows, "lcddl")


def _stretch(one: GapWindow | Intervention) -> tuple[str, str, str, str]:
    """Return run, cart, and start and end (in s) of a stretch."""
    return clean(one.experiment), str(one.cart), f"{one.start:.2f}", f"{one.end:.2f}"


def effect_parameter_table(page: Page, found: FoundEffect) -> Table:
    """Return the parameters of an effect with their standard errors."""
    symbols = {p.name: p.symbol for p in found.effect.parameters}
    rows = [
        (
            symbols[name],
            name.replace("_", " ") + (", a detail of the contact" if detail else ""),
            with_error(value.value, value.std),
            unit_text(clean(value.unit)) or "1",
        )
        for detail, group in ((False, found.parameters), (True, found.details))
        for name, value in group.items()
    ]
    return page.table(WORDS, "effect_table", rows, "lldl", effect=found.effect.title)


def rival_table(page: Page, found: FoundEffect, gap: Gap) -> Table:
    """Return the effects that were fully fitted in place of this one, with their scores."""

    def line(name: str, error: float, confidence: float, tone: Tone = "") -> list[Cell]:
        weight = f"{100 * confidence:.1f} %" if confidence >= 5e-4 else "< 0.1 %"
        return [cell(name, tone), cell(share(error), tone), cell(weight, tone)]

    sure = gap.verdict in ("named", "partial")
    name = effect_name(found.effect, found.where)
    chosen = line(name, gap.final, found.confidence, "good" if sure else "")
    others = [
        line(effect_name(rival.effect, rival.where), rival.nrmse_after, rival.confidence)
        for rival in found.rivals
    ]
    return page.table(WORDS, "rival_table", [chosen, *others], "ldd")
