"""The tables of a gap report."""

from collections.abc import Sequence

from pipeline.gap.types import FoundEffect, Gap, GapWindow
from pipeline.report.document import Cell, Table
from pipeline.report.gap.words import WORDS, effect_name, phase, share
from pipeline.report.numbers import percent, unit_text, with_error
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import clean


def error_table(gap: Gap, *, number: int) -> Table:
    """Return the error on held-out runs, step by step, against noise and repeatability."""
    rows = [[cell("linear model"), cell(share(gap.baseline))]]
    rows += [
        [cell(f"with {effect_name(found.effect, found.where)}"), cell(share(found.nrmse_after))]
        for found in gap.effects
    ]
    rows.append([cell("noise alone", "quiet"), cell(share(gap.noise_floor), "quiet")])
    if gap.repeatability is not None:
        rows.append(
            [cell("repeats of one run differ by", "quiet"), cell(share(gap.repeatability), "quiet")]
        )
    return make_table(number, WORDS.text("error_table"), ("Model", "Error"), rows, "ld")


def window_table(windows: Sequence[GapWindow], *, model: str, number: int) -> Table:
    """Return where a model, named by a key of the catalogue, fails most."""
    return make_table(
        number,
        WORDS.text("window_table", model=WORDS.text(model)),
        ("Run", "Cart", "From [s]", "To [s]", "What happens", "Share"),
        [
            [
                cell(clean(w.experiment)),
                cell(str(w.cart)),
                cell(f"{w.start:.2f}"),
                cell(f"{w.end:.2f}"),
                cell(phase(w.what)),
                cell(percent(100 * w.share)),
            ]
            for w in windows
        ],
        "lcddld",
    )


def effect_parameter_table(found: FoundEffect, *, number: int) -> Table:
    """Return the parameters of an effect with standard errors."""
    symbols = {p.name: p.symbol for p in found.effect.parameters}
    rows = [
        [
            cell(symbols[name]),
            cell(name.replace("_", " ") + (", a detail of the contact" if detail else "")),
            cell(with_error(value.value, value.std)),
            cell(unit_text(clean(value.unit)) or "1"),
        ]
        for detail, group in ((False, found.parameters), (True, found.details))
        for name, value in group.items()
    ]
    return make_table(
        number,
        f"{found.effect.title}: parameters with standard errors.",
        ("Symbol", "Parameter", "Value", "Unit"),
        rows,
        "lldl",
    )


def rival_table(found: FoundEffect, gap: Gap, *, number: int) -> Table:
    """Return the effects tried in this one's stead, each fitted as fully, with their scores."""

    def line(name: str, error: float, confidence: float, tone: str = "") -> list[Cell]:
        weight = f"{100 * confidence:.1f} %" if confidence >= 5e-4 else "< 0.1 %"
        return [cell(name, tone), cell(share(error), tone), cell(weight, tone)]

    return make_table(
        number,
        WORDS.text("rival_table"),
        ("Effect", "Error on held-out runs", "Weight"),
        [
            line(effect_name(found.effect, found.where), gap.final, found.confidence, "good"),
            *(
                line(effect_name(r.effect, r.where), r.nrmse_after, r.confidence)
                for r in found.rivals
            ),
        ],
        "ldd",
    )
