"""The verdict of the gap analysis, as a section of the report.

It is included if the folder has a gap analysis of the same data.
"""

from collections.abc import Sequence

from matplotlib.figure import Figure

from pipeline.gap.replay import Replay, replay_driven
from pipeline.gap.types import Gap
from pipeline.plant.effect import effect_name
from pipeline.report.document import Block, paragraph
from pipeline.report.equations.effects import augmented_equations, in_order, law
from pipeline.report.figures.style import (
    keep_in_sight,
    legend_above,
    panels,
    plot_measured,
    plot_model,
    plot_second,
    position_label,
)
from pipeline.report.gap.tables import error_table
from pipeline.report.gap.verdict import (
    WORDS,
    added_name,
    error_board,
    next_block,
    scope_blocks,
    share,
    shares,
    verdict_blocks,
    verdict_title,
)
from pipeline.report.sections.page import Page
from pipeline.words.numbers import listing
from pipeline.words.text import capital, clean

_MOST_RUNS = 4


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
    blocks = [*verdict_blocks(gap), error_board(gap), error_table(page, gap)]
    terms = gap.model.terms
    if terms:
        blocks.append(augmented_equations(page.analysis.bench.springs, terms))
        blocks += [law(terms, index) for index in in_order(terms)]
    if gap.verdict == "none":
        blocks += scope_blocks(gap, position=page.position, drive=page.drive)
    return [*blocks, *next_block(gap), paragraph(WORDS.spans("story"))]


# ---------------------------------------------------------------------- the bench


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
    drawn = [(run, found) for run, found in replays.items() if found][:_MOST_RUNS]
    for i, (run, found) in enumerate(drawn, start=1):
        worst = max(found, key=lambda replay: replay.nrmse)
        figure = _replay_figure(found, position_unit=page.position, added=added)
        values = {"run": run, "error": share(worst.nrmse), "cart": worst.check.cart, "added": added}
        blocks.append(
            page.picture(f"hardware-effects-{i}", figure, WORDS, "replay_figure", **values)
        )
    return blocks


def _replay_figure(replays: Sequence[Replay], *, position_unit: str, added: str) -> Figure:
    figure, axes = panels(*[1.05] * len(replays))
    for ax, replay in zip(axes, replays, strict=True):
        check = replay.check
        plot_measured(ax, check.t, check.measured)
        plot_second(ax, check.t, check.model, label="linear model")
        plot_model(ax, check.t, replay.model, label=added)
        keep_in_sight(ax, check.measured)
        ax.set_ylabel(position_label(check.cart, position_unit))
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure
