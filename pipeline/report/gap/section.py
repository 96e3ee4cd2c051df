"""The gap's verdict inside the report, where a gap analysis of the same data lies beside it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.errors import ConfigError, DataError
from pipeline.estimation.measured_run import measured_run
from pipeline.gap.stored import read_gap
from pipeline.gap.types import Gap
from pipeline.plant.nonlinear.effects import AugmentedChain
from pipeline.report import limits
from pipeline.report.document import Block, paragraph
from pipeline.report.equations.effects import augmented_equations, law
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
from pipeline.report.gap.words import (
    WORDS,
    added_name,
    effect_name,
    error_board,
    next_block,
    scope_blocks,
    share,
    shares,
    verdict_blocks,
    verdict_title,
)
from pipeline.report.numbers import listing
from pipeline.report.sections.page import Page
from pipeline.report.words import capital, clean
from pipeline.results import Analysis, HardwareCheck, Record
from pipeline.submission.toml_file import read_text

_PLACES = ("gap/gap.json", "gap.json")  # in the submission's folder
_MOST_BYTES = 10_000_000  # ten times that of three carts and a hundred runs
_MOST_RUNS = 4


def with_gap(analysis: Analysis, folder: Path) -> tuple[Analysis, Gap | None]:
    """Return the analysis, and the gap analysis of the same data that lies in its folder.

    One that is of other data or cannot be read becomes a warning.
    """
    gap, warning = _find(folder, analysis)
    if warning:
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
    return analysis, gap


def _find(folder: Path, analysis: Analysis) -> tuple[Gap | None, str]:
    for place in _PLACES:
        path = folder / place
        if not path.is_file():
            continue
        try:
            text = read_text(path, where=place, limit=_MOST_BYTES, error=ConfigError)
            gap, files = read_gap(text)
            if gap.linear.chain.n != analysis.carts:
                raise ConfigError(f"it is of {gap.linear.chain.n} carts")
        except ConfigError as error:
            return None, f"{place} cannot be used: {error}"
        if files != analysis.files:
            return None, f"{place} is of other data than this report: run cartlab gap again"
        return gap, ""
    return None, ""


def gap_in_short(gap: Gap | None) -> list[Block]:
    """Return the verdict in one paragraph, which leads to the section about it."""
    if gap is None:
        return []
    name = listing([effect_name(found.effect, found.where) for found in gap.effects])
    names = f" ({name})" if name and gap.verdict in ("named", "partial") else ""
    said = WORDS.spans(
        "in_short" if gap.effects else "in_short_linear",
        verdict=f"{verdict_title(gap)}{names}",
        **shares(gap),
    )
    return [paragraph(said)]


def gap_blocks(page: Page, gap: Gap | None) -> list[Block]:
    """Return the verdict, its errors, and the equations with the effects."""
    if gap is None:
        return []
    blocks = [*verdict_blocks(gap), error_board(gap), error_table(page, gap)]
    terms = gap.model.terms
    if terms:
        blocks.append(augmented_equations(page.analysis.springs, terms))
        blocks += [law(terms, index) for index in range(len(terms))]
    if gap.verdict == "none":
        blocks += scope_blocks(gap, position=page.position, drive=page.drive)
    return [*blocks, *next_block(gap), paragraph(WORDS.spans("story"))]


# ---------------------------------------------------------------------- the bench


@dataclass(frozen=True, kw_only=True, eq=False)
class _Replay:
    """One cart under the measured input: the linear model, and the one with effects, (n,)."""

    check: HardwareCheck
    model: Array
    nrmse: float


def augmented_hardware_blocks(page: Page, gap: Gap | None) -> list[Block]:
    """Return the model with effects beside the linear one, both driven by the measured input."""
    if gap is None or not gap.model.terms:
        return []
    opened = [check for check in page.analysis.hardware if check.loop == "open"]
    runs = list(dict.fromkeys(check.experiment for check in opened))
    replays = {
        run: _replay(page.records[run], [c for c in opened if c.experiment == run], gap.model)
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
    head = ("Record", "Cart", "Linear model", capital(added))
    table = page.table(WORDS.text("replay_table", added=added), head, rows, "lcdd")
    blocks: list[Block] = [paragraph(WORDS.spans("replay", added=added)), table]
    drawn = [(run, found) for run, found in replays.items() if found][:_MOST_RUNS]
    for i, (run, found) in enumerate(drawn, start=1):
        worst = max(found, key=lambda replay: replay.nrmse)
        cart, error = worst.check.cart, share(worst.nrmse)
        blocks.append(
            page.picture(
                f"hardware-effects-{i}",
                _replay_figure(found, position_unit=page.position, added=added),
                caption=WORDS.text("replay_caption", run=run, added=added),
                alt=WORDS.text("replay_alt", run=run, error=error, cart=cart, added=added),
            )
        )
    return blocks


def _replay(
    record: Record, checks: Sequence[HardwareCheck], model: AugmentedChain
) -> list[_Replay]:
    """Simulate a run with the measured input; [] where the carts run away or nothing drives."""
    # Compiled code: the linear report never needs it.
    from pipeline.plant.nonlinear.augmented import rest_positions, simulate_augmented

    if record.u is None:
        return []
    run = measured_run(record, model.chain)
    rows = [cart - 1 for cart in run.free]
    try:
        rest = rest_positions(model, free=run.free)
        x0 = rest.copy()
        x0[rows] += run.x0[::2]
        factors = {1.0, *(c.input_scale for c in checks if c.input_scale is not None)}
        found = [
            run.rest[:, None] + (y - rest[:, None])[rows]
            for factor in sorted(factors, key=lambda factor: factor != 1.0)
            if factor == 1.0 or not 1 / limits.OTHER_SCALE <= factor <= limits.OTHER_SCALE
            for y in [simulate_augmented(model, record.t, factor * record.u, free=run.free, x0=x0)]
        ]
    except DataError:
        return []
    as_logged, *others = found
    best = min(others, key=run.misfit, default=as_logged)
    chosen = best if run.misfit(best) < limits.WORTH_SCALING * run.misfit(as_logged) else as_logged
    replays = []
    for check in checks:
        row = run.free.index(check.cart)
        motion = check.measured - run.rest[row]
        error = float(np.sqrt(np.sum((check.measured - chosen[row]) ** 2) / np.sum(motion**2)))
        replays.append(_Replay(check=check, model=chosen[row], nrmse=error))
    return replays


def _replay_figure(replays: Sequence[_Replay], *, position_unit: str, added: str) -> Figure:
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
