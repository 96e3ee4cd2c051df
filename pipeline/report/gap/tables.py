"""The tables of a gap report."""

from collections.abc import Sequence

from pipeline.gap.types import FoundEffect, Gap, GapWindow
from pipeline.plant.effect import effect_name
from pipeline.report.document import Cell, Table, Tone, cell
from pipeline.report.gap.verdict import WORDS, kept_together, phase, share
from pipeline.report.sections.page import Page
from pipeline.results import Intervention
from pipeline.words.numbers import listing, percent, unit_text, with_error
from pipeline.words.text import clean


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
        limits.append(("repeats of one run differ by", gap.repeatability))
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
