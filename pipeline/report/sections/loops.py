"""Sections on control: the designed feedback, and the comparison of model and measurement."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.report.builder import Page
from pipeline.report.document import Block, Code, Table, paragraph
from pipeline.report.equations.model import controller_equations, matlab_code, weights_formula
from pipeline.report.figures.time import HardwareRun, design_figure, hardware_figure
from pipeline.results import FeedbackDesign, HardwareCheck, Margins
from pipeline.words.numbers import NOTHING, complex_text, count, percent, significant, unit_text
from pipeline.words.phrases import phrases
from pipeline.words.text import clean

_WORDS = phrases("measurements")
# Share of the motion (rms). A good linear model has a smaller error; a larger one raises a
# question.
CLOSE = 0.10
_MANY_RUNS = 2  # With more runs than this, the table has a row for each run, not for each cart.
_SCALED = 0.05  # A factor on the logged input that differs from 1 by less is not worth mentioning.


def feedback_blocks(page: Page) -> list[Block]:
    """Return gains, margins, poles and simulated step of the designed feedback.

    Everything that is needed to compute them again is printed with all its digits.
    """
    design, chain = page.analysis.feedback, page.analysis.chain
    if design is None or chain is None:
        return []
    settling = design.settling_time
    values = {
        "cart": design.cart,
        "goal": f"{significant(design.reference)} {page.position}",
        "overshoot": percent(design.overshoot_percent),
        "peak": significant(design.peak_input, digits=3),
        "drive": page.drive,
        "settled": _WORDS.text("never_settles")
        if settling is None
        else _WORDS.text("settles", seconds=significant(settling, digits=3)),
    }
    method = _WORDS.text(f"method_{design.method}")
    figure = design_figure(design, units=page.units)
    weights = [] if design.Q is None else _weights(design.Q)
    return [
        paragraph(_WORDS.text("feedback", method=method, message=clean(design.message))),
        _feedback_table(page, design),
        *weights,
        paragraph(_WORDS.text("controller", seconds=significant(design.sample_time, digits=5))),
        controller_equations(),
        *_margin_table(page, design),
        _pole_table(page, design),
        page.picture("feedback", figure, _WORDS, "design", **values),
        paragraph(_WORDS.text("in_matlab")),
        Code(matlab_code(chain, design)),
    ]


def _weights(Q: Array) -> list[Block]:
    return [paragraph(_WORDS.text("weights")), weights_formula(Q)]


def _feedback_table(page: Page, design: FeedbackDesign) -> Table:
    """Return gains, prefilter, and the properties of the simulated step."""
    shown = replace(design, units=page.units).quantities()
    rows = [(what, value, unit_text(unit)) for what, value, unit in shown]
    goal = f"{significant(design.reference)} {page.position}"
    return page.table(_WORDS, "feedback_table", rows, "ldl", cart=design.cart, goal=goal)


def _margin_table(page: Page, design: FeedbackDesign) -> list[Block]:
    """Return the margins with the observer of the design, and with that of cartlab's bench."""
    if design.margins is None:
        return []
    rows = zip(margin_rows(design.margins), margin_rows(design.bench_margins), strict=True)
    return [page.table(_WORDS, "margin_table", [(*own, bench[1]) for own, bench in rows], "lll")]


def margin_rows(margins: Margins | None) -> list[tuple[str, str]]:
    """Return the name and the text of each margin; without margins, the loop is unstable."""
    if margins is None:
        return [(f"{name} margin", "unstable") for name in ("gain", "phase", "modulus")]
    gain, phase = margins.gain, margins.phase_deg
    factor = turn = "no limit"
    if gain is not None:
        decibel = f"{significant(20 * np.log10(gain), digits=3)} dB"
        factor = f"{significant(gain, digits=3)} ({decibel}) {_at(margins.omega_gain)}"
    if phase is not None:
        side = "lead" if phase < 0 else "lag"
        turn = f"{significant(abs(phase), digits=3)}° of {side} {_at(margins.omega_phase)}"
    return [
        ("gain margin", factor),
        ("phase margin", turn),
        ("modulus margin", significant(margins.modulus, digits=3)),
    ]


def _at(omega: float | None) -> str:
    return f"at {significant(omega, digits=3)} rad/s"


def _pole_table(page: Page, design: FeedbackDesign) -> Table:
    """Return the closed-loop poles, next to the requested ones if there are any."""
    rows = [
        [
            complex_text(pole, digits=3),
            significant(abs(pole), digits=3),
            significant(-pole.real / abs(pole), digits=3) if pole != 0 else NOTHING,
        ]
        for pole in _ascending(design.poles)
    ]
    if design.requested_poles is None:
        return page.table(_WORDS, "pole_table", rows, "rrr")
    # A delay adds poles that were not requested.
    requested = [complex_text(pole, digits=3) for pole in _ascending(design.requested_poles)]
    requested += [NOTHING] * (len(rows) - len(requested))
    rows = [[asked, *row] for asked, row in zip(requested, rows, strict=True)]
    return page.table(_WORDS, "requested_pole_table", rows, "rrrr")


def _ascending(poles: ComplexArray) -> ComplexArray:
    return poles[np.lexsort((poles.imag, np.abs(poles)))]


def hardware_blocks(page: Page) -> list[Block]:
    """Return the comparison of model and measurement: a table of all runs, and one figure.

    The figure shows at most two runs: the one with the largest and the one with the smallest
    difference.
    """
    checks = page.analysis.hardware
    if not checks:
        return []
    runs = [
        HardwareRun(
            name=clean(run),
            checks=[check for check in checks if check.experiment == run],
            record=page.records.get(run),
        )
        for run in dict.fromkeys(check.experiment for check in checks)
    ]
    worst, *others = sorted(runs, key=lambda run: -run.worst.nrmse)
    drawn = [worst, *others[-1:]]
    said = {
        "run": worst.name,
        "cart": worst.worst.cart,
        "carts": count(len({check.cart for check in worst.checks}), "cart"),
        "left": percent(100 * worst.worst.nrmse),
        "others": _WORDS.text("hardware_best", runs=len(runs), run=drawn[-1].name)
        if others
        else "",
    }
    figure = hardware_figure(drawn, units=page.units)
    return [
        _hardware_table(page, runs),
        page.picture("hardware", figure, _WORDS, "hardware", **said),
    ]


def _hardware_table(page: Page, runs: Sequence[HardwareRun]) -> Table:
    """Return the numbers of every run: a row for each cart, or for many runs, one for each run."""
    many = len(runs) > _MANY_RUNS
    scaled_runs = {check.experiment for check in page.analysis.hardware if check.is_scaled}
    shown = [
        [check for check in run.checks if check.loop == loop]
        for run in runs
        for loop in dict.fromkeys(check.loop for check in run.checks)
    ]
    rows = [
        (
            clean(check.experiment),
            str(check.cart),
            "loop" if check.loop == "closed" else "measured input",
            percent(100 * check.nrmse),
            _overshoots(check),
            _pair(check.settling_model, check.settling_measured),
            _pair(check.steady_state_model, check.steady_state_measured),
            _input_factor(check, used=check.experiment in scaled_runs),
        )
        for checks in shown
        for check in ([_telling(checks)] if many else checks)
    ]
    # The factor is shown where a difference from 1 is worth mentioning.
    scales = [check.input_scale for run in runs for check in run.checks]
    scaled = any(scale is not None and abs(scale - 1) > _SCALED for scale in scales)
    columns = None if scaled else 7
    said = {
        "position": page.position,
        "many": _WORDS.text("hardware_table_many") if many else "",
        "factor": _WORDS.text("hardware_table_factor") if scaled else "",
    }
    shown_rows = [row[:columns] for row in rows]
    return page.table(_WORDS, "hardware_table", shown_rows, "lcldrrrd"[:columns], **said)


def _telling(checks: Sequence[HardwareCheck]) -> HardwareCheck:
    """Return the check of the controlled cart or, if it is unknown, the largest difference."""
    return max(checks, key=lambda check: (check.set_point is not None, check.nrmse))


def _input_factor(check: HardwareCheck, *, used: bool) -> str:
    if check.input_scale is None:
        return NOTHING
    return f"{significant(check.input_scale, digits=3)}{', used' if used else ''}"


def _overshoots(check: HardwareCheck) -> str:
    pair = (check.overshoot_model, check.overshoot_measured)
    if pair == (None, None):
        return NOTHING
    return " / ".join(percent(value).removesuffix(" %") for value in pair)


def _pair(model: float | None, measured: float | None) -> str:
    if model is None and measured is None:
        return NOTHING
    return f"{significant(model, digits=3)} / {significant(measured, digits=3)}"
