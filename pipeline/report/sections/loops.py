"""Sections on control: the designed feedback, and model against measurement."""

from pipeline.report.document import Block, paragraph
from pipeline.report.figures.time import design_figure, hardware_figure
from pipeline.report.numbers import count, percent, significant
from pipeline.report.sections.page import Page, left_out, remarks
from pipeline.report.tables import feedback_table, hardware_table, pole_table
from pipeline.report.words import clean

_MOST_RUNS = 4  # runs drawn; the table holds all
_AS_LOGGED = 0.05  # a factor on the input this near one is not worth a word


def feedback_blocks(page: Page) -> list[Block]:
    """Return gains, poles and the simulated step of the designed feedback."""
    design = page.analysis.feedback
    if design is None:
        return []
    method = {"lqr": "a linear quadratic regulator", "poles": "pole placement"}[design.method]
    goal = f"{significant(design.reference)} {page.position}"
    settled = (
        f"settles in {significant(design.settling_time, digits=3)} s (dotted)"
        if design.settling_time is not None
        else "does not settle here"
    )
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
            caption=f"Simulated step of {goal} with the designed feedback: cart {design.cart} "
            f"(thick) {settled} with {percent(design.overshoot_percent)} overshoot, and the input "
            f"peaks at {significant(design.peak_input, digits=3)} {page.drive}. Shaded: its 2 % "
            "band.",
            alt=f"Simulated step response: cart {design.cart} reaches {goal} with "
            f"{percent(design.overshoot_percent)} overshoot; the input peaks at "
            f"{significant(design.peak_input, digits=3)} {page.drive}.",
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
                caption=f"{run}: the real system (points) and the model, cart by cart; below each, "
                f"what the model leaves. Most is left at cart {worst.cart}: "
                f"{percent(100 * worst.nrmse)} of the motion (root mean square)."
                f"{left_out(len(runs) - _MOST_RUNS) if i == _MOST_RUNS else ''}",
                alt=f"Measured and modelled motion of {count(len(carts), 'cart')} in {run}; the "
                f"largest difference is {percent(100 * worst.nrmse)} of the motion, at cart "
                f"{worst.cart}.",
            )
        )
    scales = [
        f"{c.experiment}: the logged input explains the motion best when multiplied by "
        f"{significant(c.input_scale, digits=3)}"
        for c in checks
        if c.input_scale is not None and abs(c.input_scale - 1) > _AS_LOGGED
    ]
    return [*blocks, *remarks(list(dict.fromkeys(scales)))]
