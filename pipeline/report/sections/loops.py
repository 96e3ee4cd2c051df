"""Sections on control: the designed feedback, and model against measurement."""

from pipeline.report.document import Block, paragraph
from pipeline.report.figures.time import design_figure, hardware_figure
from pipeline.report.numbers import count, percent, significant
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page, remarks
from pipeline.report.tables.loops import feedback_table, hardware_table, pole_table
from pipeline.report.words import clean

_WORDS = phrases("measurements")
_AS_LOGGED = 0.05  # a factor on the input this near one is not worth a word


def feedback_blocks(page: Page) -> list[Block]:
    """Return gains, poles and the simulated step of the designed feedback."""
    design = page.analysis.feedback
    if design is None:
        return []
    said = {
        "cart": str(design.cart),
        "goal": f"{significant(design.reference)} {page.position}",
        "overshoot": percent(design.overshoot_percent),
        "peak": significant(design.peak_input, digits=3),
        "drive": page.drive,
    }
    settled = (
        _WORDS.text("settles", seconds=significant(design.settling_time, digits=3))
        if design.settling_time is not None
        else _WORDS.text("never_settles")
    )
    method = _WORDS.text(f"method_{design.method}")
    return [
        paragraph(_WORDS.text("feedback", method=method, message=clean(design.message))),
        feedback_table(design, number=page.table_number(), units=(page.position, page.drive)),
        pole_table(design, number=page.table_number()),
        page.picture(
            "feedback",
            design_figure(design, position_unit=page.position, input_unit=page.drive),
            caption=_WORDS.text("design", settled=settled, **said),
            alt=_WORDS.text("design_alt", **said),
        ),
    ]


def hardware_blocks(page: Page) -> list[Block]:
    """Return model against measurement of every run, cart by cart."""
    checks = page.analysis.hardware
    if not checks:
        return []
    table = hardware_table(checks, number=page.table_number(), position_unit=page.position)
    blocks: list[Block] = [table]
    runs = list(dict.fromkeys(check.experiment for check in checks))
    for i, run in enumerate(runs, start=1):
        own = [check for check in checks if check.experiment == run]
        carts = sorted({check.cart for check in own})
        figure = hardware_figure(
            [[check for check in own if check.cart == cart] for cart in carts],
            record=page.records.get(run),
            position_unit=page.position,
            input_unit=page.drive,
        )
        worst = max(own, key=lambda check: check.nrmse)
        said = {"run": run, "cart": str(worst.cart), "left": percent(100 * worst.nrmse)}
        blocks.append(
            page.picture(
                f"hardware-{i}",
                figure,
                caption=_WORDS.text("hardware", **said),
                alt=_WORDS.text("hardware_alt", carts=count(len(carts), "cart"), **said),
            )
        )
    scales = [
        _WORDS.text("input_scale", run=c.experiment, scale=significant(c.input_scale, digits=3))
        for c in checks
        if c.input_scale is not None and abs(c.input_scale - 1) > _AS_LOGGED
    ]
    return [*blocks, *remarks(list(dict.fromkeys(scales)))]
