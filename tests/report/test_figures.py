"""Figures have the right content and ticks, and the same data give the same bytes."""

import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.text import Text
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.gap.residual import ResidualForce
from pipeline.plant.chain import Chain
from pipeline.report.builder import Page
from pipeline.report.document import Table
from pipeline.report.figures import CARTS, MEASURED, MODEL, QUIET
from pipeline.report.figures.bode import bode_figure, overview_figure, plot_phase
from pipeline.report.figures.gap import (
    force_figure,
    force_left_figure,
    spectrum_figure,
    timing_figure,
)
from pipeline.report.figures.grading import distribution_figure
from pipeline.report.figures.style import (
    DigitTicks,
    drawing,
    log_scale,
    panels,
    plot_measured,
    plot_model,
    plot_points,
    small_multiples,
    thin,
    to_svg,
)
from pipeline.report.figures.time import (
    HardwareRun,
    damping_figure,
    decay_figure,
    design_figure,
    hardware_figure,
    sine_figure,
    step_figure,
    sweep_figure,
)
from pipeline.report.sections.loops import hardware_blocks
from pipeline.report.sections.measurements import (
    dwell_blocks,
    response_blocks,
    step_blocks,
    sweep_blocks,
)
from pipeline.results import Analysis, FrequencyResponse, Record
from pipeline.setup import PAPER_UNITS, Units
from pipeline.words.numbers import significant
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.gaps import RESIDUAL, make_gap
from tests.helpers.pages import pictures

COUNTS = Units(position="count", input="V")
SVG = "{http://www.w3.org/2000/svg}"


@cache
def response_of(carts: int, cart: int) -> FrequencyResponse:
    return make_analysis(carts).frequency_responses[cart - 1]


def bode(response: FrequencyResponse, *, carts: int = 0) -> Figure:
    """Return the Bode plot of a response, with the model of so many carts if there are any."""
    chain = make_analysis(carts).chain if carts else None
    with drawing():
        return bode_figure(response, chain=chain, units=PAPER_UNITS)


def drawn(figure: Figure, alt: str = "") -> str:
    """Return the figure as the page shows it."""
    with drawing():
        return to_svg(figure, name="x", alt=alt)


def data(line: Any, axis: str) -> np.ndarray:
    """Return what a line shows along an axis."""
    return np.asarray(line.get_xdata() if axis == "x" else line.get_ydata(), dtype=float)


def marked(ax: Axes, *markers: str) -> list[Any]:
    return [line for line in ax.lines if line.get_marker() in markers]


def test_a_figure_is_valid_svg_with_a_text_alternative():
    """The SVG of a figure is valid, has a text alternative, and its labels are text.

    Each of the 24 dwells is a diamond in all three panels; the legend has one more.
    """
    root = ElementTree.fromstring(drawn(bode(response_of(2, 1), carts=2), alt="Bode <plot>"))
    assert len(list(root.iter(f"{SVG}use"))) == 3 * 24 + 1
    assert root.attrib["role"] == "img"
    assert root.findtext(f"{SVG}title") == "Bode <plot>"
    texts = {"".join(text.itertext()) for text in root.iter(f"{SVG}text")}
    assert {"ω [rad/s]", "|X₁/U| [dB re 1 cm/V]"} <= texts
    assert root.find(f"{SVG}metadata") is None


@pytest.mark.parametrize(("carts", "marks"), [(1, {"ωₙ"}), (2, {"a", "b"})])
def test_resonances_are_marked(carts, marks):
    """Dotted lines mark the resonances: one of a single cart is ω_n, others have their letters."""
    root = ElementTree.fromstring(drawn(bode(response_of(carts, 1), carts=carts), alt="Bode"))
    texts = {"".join(text.itertext()) for text in root.iter(f"{SVG}text")}
    assert marks <= texts
    assert not {"n"} & texts


def test_the_phase_of_noise_is_drawn_near_that_of_the_signal():
    """Without a fit, noise whose phase turns on and on is drawn near the phase of the signal."""
    response = response_of(3, 3)
    quiet = np.arange(response.omega.size) >= response.omega.size // 2
    magnitude = np.where(quiet, response.magnitude_std, response.magnitude)
    turning = np.angle(np.exp(2.5j * np.arange(response.omega.size)))
    assert response.phase is not None
    phase = np.where(quiet, turning, response.phase)
    response = replace(response, magnitude=magnitude, phase=phase)
    with drawing():
        _, (ax,) = panels(1.0)
        plot_phase(ax, response, chain=None)
    drawn = np.concatenate([np.asarray(line.get_xydata()) for line in ax.lines])
    last = np.degrees(np.unwrap(phase[~quiet])[-1])
    of_noise = drawn[drawn[:, 0] >= response.omega[quiet][0], 1]
    assert of_noise.size >= quiet.sum()
    assert np.all(np.abs(of_noise - last) <= 180.001)


def test_a_measured_phase_is_drawn_near_the_models():
    """A measured phase is shifted by full turns so that it is drawn near the model's phase."""
    response = response_of(3, 3)  # its phase goes down to -540°
    _, phase, _ = bode(response, carts=3).axes
    line, points = phase.lines[:2]
    assert response.phase is not None
    assert np.min(response.phase) > -np.pi
    assert data(line, "y").min() < -500
    # With noise of 0.01 rad and 300 points on the line, the difference is well below 15°.
    at = np.interp(response.omega, data(line, "x"), data(line, "y"))
    assert np.max(np.abs(data(points, "y") - at)) < 15


def test_an_infinite_peak_does_not_hide_the_measurement():
    """If undamped carts have infinite peaks, the axis ends at most 50 dB above the measurement."""
    chain = Chain(m=np.array([1.0]), c=np.zeros(1), k=np.array([4.0, 0.0]))
    omega = np.array([0.5, 1.0, 3.0, 4.0])
    magnitude = np.abs(chain.frequency_response(omega)[0])
    response = replace(
        response_of(1, 1), omega=omega, magnitude=magnitude, magnitude_std=0.01 * magnitude,
        phase=np.zeros(4), phase_std=np.full(4, 0.01),
    )  # fmt: skip
    with drawing():
        figure = bode_figure(response, chain=chain, units=PAPER_UNITS)
    ElementTree.fromstring(drawn(figure))
    assert figure.axes[0].get_ylim()[1] < 20 * np.log10(magnitude.max()) + 50


def test_the_axis_of_an_input_covers_all_samples():
    """The axis of an input covers all samples, even if no model is drawn."""
    with drawing():
        _, (ax,) = panels(1.0)
        plot_points(ax, np.linspace(0, 1, 5), np.array([-4.0, 0, 3, 0, 0]))
    low, high = ax.get_ylim()
    assert low <= -4
    assert high >= 3


def test_dollar_signs_are_drawn_as_they_are():
    """Dollar signs in an id are drawn as they are, not as a formula."""
    with drawing():
        figure, (ax,) = panels(1.0)
        plot_measured(ax, np.linspace(0, 1, 5), np.zeros(5))
        ax.set_ylim(-1, 1)
        ax.set_title("$\\frac{$ <b> 中文 &", loc="left")
        svg = to_svg(figure, name="x", alt="")
    assert "$\\frac{$ &lt;b&gt; 中文 &amp;" in svg


def test_an_unstable_model_does_not_hide_the_measurement():
    """If a simulation grows without bound, the axis ends at most one span beyond the data."""
    check = make_analysis(1).hardware[0]
    growth = np.append(np.exp(np.linspace(0, 700, check.t.size - 1)), np.inf)
    for model in (1e12 * check.model, growth):
        grown = HardwareRun(name="run", checks=[replace(check, model=model)])
        with drawing():
            figure = hardware_figure([grown], units=PAPER_UNITS)
        drawn(figure)
        assert np.ptp(figure.axes[0].get_ylim()) <= 3.01 * np.ptp(check.measured)


def test_a_zero_in_a_table_of_ratios_is_left_out():
    """A zero in a table of ratios is omitted from the logarithmic plot; other points are drawn."""
    response = response_of(1, 1)
    magnitude = np.where(np.arange(24) == 3, 0.0, response.magnitude)
    table = replace(response, magnitude=magnitude, phase=None, phase_std=None)
    root = ElementTree.fromstring(drawn(bode(table)))
    assert len(list(root.iter(f"{SVG}use"))) == 23 + 1  # and one diamond in the legend


@pytest.mark.parametrize("cart", [1, 2, 3])
def test_points_without_signal_are_grey_and_not_counted(cart):
    """A point within the noise is grey in every panel, and the caption only counts it."""
    response = response_of(3, cart)
    magnitude, std = response.magnitude.copy(), response.magnitude_std.copy()
    magnitude[-1] *= 1e4  # an amplitude of noise alone, where the carts hardly move
    std[-1] = 0.6 * magnitude[-1]
    magnitude[5] *= 1.8  # a clear point far off the fit
    response = replace(response, magnitude=magnitude, magnitude_std=std)
    for ax in bode(response, carts=3).axes:
        measured, faint = marked(ax, "D")
        assert (measured.get_color(), faint.get_color()) == (MEASURED, QUIET)
        assert_array_equal(data(faint, "x"), response.omega[-1:])
        assert_array_equal(data(measured, "x"), response.omega[:-1])
    page = Page(replace(make_analysis(3), frequency_responses=(response,)))
    (picture,) = pictures(response_blocks(page)).values()
    caption = plain(picture.caption)
    farthest = significant(response.omega[5], digits=3)
    (percent,) = re.findall(rf"{farthest} rad/s, lies (\d+) %", caption)
    assert 79 <= int(percent) < 90  # 80 %, and 1 % of noise
    assert "1 point" in caption
    assert f"{significant(response.omega[-2], digits=3)} rad/s" in picture.alt


@pytest.mark.parametrize("factor", [0.2, 1.8, 300.0])
def test_the_residual_axis_is_clipped_with_a_mark(factor):
    """A far point does not hide the others: the axis is clipped, and a triangle marks the point."""
    response = response_of(3, 1)
    magnitude = np.where(np.arange(24) == 5, factor, 1.0) * response.magnitude
    residual = bode(replace(response, magnitude=magnitude), carts=3).axes[-1]
    low, high = residual.get_ylim()
    points = data(residual.lines[1], "y")
    assert_array_equal(np.flatnonzero(np.abs(points) > high), [5])
    (mark,) = marked(residual, "^", "v")
    assert mark.get_marker() == ("^" if factor > 1 else "v")
    assert_array_equal(data(mark, "x"), response.omega[5:6])
    assert low < data(mark, "y")[0] < high
    # The limit is 30 medians and a margin of 15 %; the test's median includes the far point.
    assert 25.0 * np.median(np.abs(points)) < high < 40.0 * np.median(np.abs(points))


@pytest.mark.parametrize(("carts", "cart"), [(1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (3, 3)])
def test_residuals_without_a_far_point_are_all_shown(carts, cart):
    """Without far points the axis is not clipped; residuals are measured minus fitted."""
    response = response_of(carts, cart)
    gain, _, residual = bode(response, carts=carts).axes
    assert not marked(residual, "^", "v")
    low, high = residual.get_ylim()
    points = data(residual.lines[1], "y")
    assert low < points.min()
    assert points.max() < high
    chain = make_analysis(carts).chain
    assert chain is not None
    model = np.abs(chain.frequency_response(response.omega)[cart - 1])
    assert_allclose(points, 100 * (response.magnitude / model - 1), atol=1e-9)
    assert_allclose(data(marked(gain, "D")[0], "y"), 20 * np.log10(response.magnitude), atol=1e-9)


def test_a_dwell_is_steady_once_every_cart_is():
    """The caption of a dwell says from when every cart is steady, not only the first."""
    analysis = make_analysis(2)
    points = tuple(replace(p, steady_from=p.steady_from + p.cart) for p in analysis.sine_points)
    found = pictures(dwell_blocks(Page(replace(analysis, sine_points=points))))
    assert "6.00 s on, every" in plain(found["sine"].caption)


def test_a_dwell_shades_the_transient():
    """The figure of a dwell shades the transient up to the start of the steady part."""
    analysis = make_analysis(2)
    points = [p for p in analysis.sine_points if p.experiment == "sine-10"]
    record = next(r for r in analysis.records if r.id == "sine-10")
    with drawing():
        figure = sine_figure(points, record=record, position_unit="cm")
    for ax, point in zip(figure.axes, points, strict=True):
        (span,) = (patch for patch in ax.patches if isinstance(patch, Rectangle))
        box = span.get_extents().transformed(ax.transData.inverted())
        assert_allclose([box.x0, box.x1], [0.0, 4.0], atol=1e-9)
        low, high = (data(line, "y") for line in ax.lines if line.get_color() == MODEL)
        assert_allclose(high - low, 2 * point.amplitude)


def test_the_extrema_of_a_decay_are_drawn_at_their_times():
    """The diamonds in the figure of a decay are its extrema, in time from the release."""
    analysis = make_analysis(2)
    decay = replace(analysis.log_decrements[0], release=analysis.log_decrements[0].release + 0.25)
    record = next(r for r in analysis.records if r.id == decay.experiment)
    with drawing():
        figure = decay_figure([decay], records=[record], position_unit="cm")
    (extrema,) = marked(figure.axes[0], "D")
    assert_allclose(data(extrema, "x"), decay.peak_t - decay.release)
    assert_array_equal(data(extrema, "y"), decay.peak_y)


@pytest.mark.parametrize("cart", [1, 2])
def test_a_stiffening_spring_is_drawn_as_stiffening(cart):
    """The extra force of spring 2 over its stretch is its law, whichever of its carts was seen."""
    (found,) = make_gap("named", ("cubic_spring",)).effects
    x = np.linspace(-1.0, 1.0, 601)
    one, two = -0.2 * x, 0.8 * x  # positions of carts 1 and 2, so the stretch is x
    own, beside = (one, [0 * x, two]) if cart == 1 else (two, [one, 0 * x])
    law = np.polynomial.Polynomial([0.0, 0.0, 0.2, 0.5])  # not the same on both sides
    pull = law(x) if cart == 1 else -law(x)
    force = replace(
        small_force(cart), measured=pull, model=pull, position=own, neighbours=np.array(beside)
    )
    shown = force_figure(replace(found, where={"spring": 2}), [force], units=("cm", "V"))
    assert shown is not None
    for marker in ("o", "."):
        line = next(one for one in marked(shown.axes[0], marker) if np.size(one.get_xdata()))
        assert_allclose(data(line, "y"), law(data(line, "x")), atol=1e-12)
        assert data(line, "x").max() > 0.9


@pytest.mark.parametrize("runs", [1, 2])
def test_the_peak_of_a_spectrum_is_the_amplitude_of_the_sine(runs):
    """A sine of 1.5 cm and errors of 0.5 and 0.1 cm at 2 Hz have these peaks, however many runs."""
    t = np.arange(0.0, 20.0, 0.005)
    sine = np.sin(2 * np.pi * 2.0 * t)
    (trace, *_) = make_gap("named").traces
    one = replace(
        trace, t=t, u=0 * t, measured=1.5 * sine, baseline=sine, final=1.4 * sine, zero=0.0
    )
    figure = spectrum_figure([one] * runs, position_unit="cm")
    for line, amplitude in zip(figure.axes[0].lines, (1.5, 0.5, 0.1), strict=True):
        f, height = data(line, "x"), data(line, "y")
        assert_allclose(f[np.argmax(height)], 2.0, atol=0.05)
        assert_allclose(height.max(), amplitude, rtol=0.02)


@given(st.integers(10, 3000), st.integers(0, 2**32 - 1))
def test_thinning_keeps_the_envelope(n, seed):
    """Thinning leaves few points, in order of time, and keeps the largest and smallest values."""
    rng = np.random.default_rng(seed)
    t, y = np.sort(rng.uniform(0, 1, n)), rng.normal(size=n)
    thin_t, thin_y = thin(t, y)
    assert thin_y.max() == y.max()
    assert thin_y.min() == y.min()
    assert np.all(np.diff(thin_t) >= 0)
    assert thin_t.size <= 480


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ((0.4, 7.0), ["0.5", "1", "2", "5"]),
        ((8.0, 27.0), ["10", "15", "20"]),
        ((0.05, 900.0), ["0.1", "1", "10", "100"]),
    ],
)
def test_a_logarithmic_axis_has_round_numbers(limits, expected):
    """A logarithmic axis is labelled at round numbers, more of them over fewer decades."""
    with drawing():
        figure, (ax,) = panels(2.0)
        log_scale(ax, "y")
        ax.set_ylim(*limits)
    assert [f"{one:g}" for one in labels(figure, ax)] == expected


@pytest.mark.parametrize(
    ("limits", "digits"),
    [
        ((0.4, 7.0), [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1, 2, 3, 4, 5, 6, 7]),
        ((8.0, 27.0), [8, 9, 10, 20]),
    ],
)
@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_logarithmic_axis_has_ticks_at_all_digits(limits, digits, direction):
    """A logarithmic axis has a tick at 1 to 9 times each power of ten, within its limits."""
    with drawing():
        figure, (ax,) = panels(2.0)
        log_scale(ax, direction)
        ax.set(**{f"{direction}lim": limits})
        drawn(figure)
    (ticks,) = (artist for artist in ax.get_children() if isinstance(artist, DigitTicks))
    drawn_at, ends = np.asarray(ticks.get_path().vertices).T[:: 1 if direction == "x" else -1]
    assert_allclose(drawn_at[::2], digits)
    assert_allclose(drawn_at[1::2], digits)
    assert not ends[::2].any()
    assert np.all(ends[1::2] > 0)


def test_every_panel_of_a_bode_figure_has_ticks_at_all_digits():
    """Each panel of a Bode figure has ticks for reading frequencies."""
    figure = bode(response_of(2, 1), carts=2)
    drawn(figure)
    for ax in figure.axes:
        (ticks,) = (artist for artist in ax.get_children() if isinstance(artist, DigitTicks))
        assert len(np.asarray(ticks.get_path().vertices)) > 16


def test_the_users_matplotlib_settings_do_not_matter():
    """The user's own matplotlib settings change no figure."""
    before = drawn(bode(response_of(2, 1), carts=2))
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "svg.fonttype": "path"}):
        assert drawn(bode(response_of(2, 1), carts=2)) == before


def test_the_report_imports_only_what_it_needs():
    """The report imports neither pyplot nor pandas nor python-control, to save a second."""
    code = (
        "import sys, pipeline.report.files; "
        "print([m for m in ('matplotlib.pyplot', 'pandas', 'control', 'numba', 'scipy.signal') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


_LONGER = [pytest.mark.slow, pytest.mark.sample]
_TOUCH = 2.0  # points by which two boxes may overlap, since letters do not fill their boxes


def small_force(cart: int) -> ResidualForce:
    """Return a force of a few millivolt that changes its sign with the velocity."""
    t = np.linspace(0.0, 6.0, 601)
    v, none = np.sin(2 * np.pi * t), np.zeros(t.size)
    force = -2.4e-3 * np.sign(v)
    beside = np.zeros((2, t.size))
    return ResidualForce(
        experiment="step-1", cart=cart, held_out=True, t=t, measured=force, model=force,
        u=np.where(t > 3.0, 2.4e-3, 0.0), shaped_input=none, velocity=v, position=none,
        neighbours=beside, neighbours_velocity=beside,
    )  # fmt: skip


def figures_of(carts: int) -> dict[str, Figure]:
    """Return a figure of each kind in a report; the names of the recordings are long."""
    analysis = make_analysis(carts)
    records = {r.id: replace(r, id=f"{r.id} the second try of Tuesday") for r in analysis.records}
    long = {id_: record.id for id_, record in records.items()}
    decays = [replace(d, experiment=long[d.experiment]) for d in analysis.log_decrements]
    own = [decay for decay in decays if decay.cart == 1]
    runs = list(dict.fromkeys(gain.experiment for gain in analysis.step_gains))
    dwell = analysis.sine_points[-1].experiment
    run = HardwareRun(name=long["control"], checks=analysis.hardware, record=analysis.records[-1])
    models = {
        records[run].id: {cart: records[run].position(cart) for cart in records[run].carts}
        for run in runs
    }
    assert analysis.feedback is not None
    # A force in volt is small, so its numbers are long.
    small = replace(RESIDUAL.against[0], force=(2.4e-3, -2.4e-3), spread=(1e-4, None), formula=None)
    forces = [small_force(cart) for cart in (1, 2)]
    (friction,) = make_gap("named", ("coulomb_friction",)).effects
    force = force_figure(friction, forces, units=("cm", "V"))
    timing = timing_figure(forces, drive="V")
    assert force is not None
    assert timing is not None
    return {
        "force": force,
        "timing": timing,
        "force left": force_left_figure(replace(RESIDUAL, against=(small,))),
        "bode": bode_figure(
            analysis.frequency_responses[0], chain=analysis.chain, units=COUNTS,
        ),
        "decay": decay_figure(
            own, records=[next(r for r in records.values() if r.id == d.experiment) for d in own],
            position_unit="count",
        ),
        "damping": damping_figure(
            [d for d in decays if d.zeta_at_amplitude.size], position_unit="count"
        ),
        "steps": step_figure(
            [[g for g in analysis.step_gains if g.experiment == run] for run in runs],
            records=[records[run] for run in runs], position_unit="count",
        ),
        "sine": sine_figure(
            [p for p in analysis.sine_points if p.experiment == dwell], record=records[dwell],
            position_unit="count",
        ),
        "hardware": hardware_figure([run], units=COUNTS),
        "hardware, two runs": hardware_figure([run, replace(run, name="again")], units=COUNTS),
        "fitted steps": step_figure(
            [[g for g in analysis.step_gains if g.experiment == run] for run in runs],
            records=[records[run] for run in runs], position_unit="count", models=models,
        ),
        "sweep": sweep_figure(
            records[runs[0]], model=models[records[runs[0]].id], position_unit="count",
        ),
        "overview": overview_figure(
            analysis.frequency_responses, chain=analysis.chain, units=COUNTS,
        ),
        "feedback": design_figure(analysis.feedback, units=COUNTS),
    }  # fmt: skip


def tick_labels_out_of_view(figure: Figure) -> list[Text]:
    """Return the labels that matplotlib has made but does not draw."""
    unseen = []
    for axis in (axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)):
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks():
            if not axis.get_visible() or not low <= tick.get_loc() <= high:
                unseen.append(tick.label1)
    return unseen


@pytest.mark.parametrize(
    "carts", [1, pytest.param(2, marks=_LONGER), pytest.param(3, marks=_LONGER)]
)
def test_no_text_of_a_figure_is_cut_or_covered(carts):
    """All text in a figure lies on the canvas, and no two texts overlap."""
    with drawing():
        for name, figure in figures_of(carts).items():
            canvas = FigureCanvasAgg(figure)
            renderer = canvas.get_renderer()
            canvas.draw()
            unseen = tick_labels_out_of_view(figure)
            texts = [
                text for text in figure.findobj(Text)
                if isinstance(text, Text) and text.get_visible() and text.get_text()
                and text not in unseen
            ]  # fmt: skip
            boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in texts]
            assert len(boxes) > 8
            for text, box in boxes:
                inside = min(box.min) >= 0 and bool(np.all(box.max <= figure.bbox.max))
                assert inside, (name, text)
            for (text, box), (other, near) in combinations(boxes, 2):
                apart = np.maximum(box.min, near.min) >= np.minimum(box.max, near.max) - _TOUCH
                assert apart.any(), (name, text, other)


def test_a_long_recording_gives_a_small_drawing():
    """The points of a long recording are spread out, so its drawing stays small."""
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 9.0, 50_001)
    with drawing():
        figure, (ax,) = panels(1.0)
        plot_measured(ax, t, rng.normal(size=t.size))
        plot_model(ax, t, rng.normal(size=t.size))
    assert len(drawn(figure)) < 40_000


LONG = "DOF1_en1_input1_trial_of_monday_"


@pytest.mark.parametrize(
    ("names", "titles"),
    [
        ([*"abcde"], [*"abcde"]),
        ([f"{LONG}{i}" for i in range(6)], [*"012345"]),
        ([f"DOF1_en1_input1_test{i}" for i in range(5)], [f"test{i}" for i in range(5)]),
        (["a" * 25, "b" * 25, "c" * 25], ["a" * 25, "b" * 25, "c" * 25]),
        ([f"{'x' * 60}{i}" for i in range(3)], [f"{'x' * 12}…{'x' * 11}{i}" for i in range(3)]),
        (["step-1", "step-2"], ["step-1", "step-2"]),
    ],
)
def test_repeats_share_one_time_axis(names, titles):
    """Panels of repeated runs share one time axis; long titles leave out words that all share."""
    with drawing():
        _, axes = small_multiples(names, height=1.0, share_y=True)
        axes[0].set_xlim(0, 3)
    assert len({ax.get_xlim() for ax in axes}) == 1
    assert len({round(ax.get_position().x0, 6) for ax in axes}) == min(3, len(names))
    assert [ax.get_title(loc="left") for ax in axes] == titles


@pytest.mark.parametrize(("least", "step"), [(-360.0, 90.0), (-540.0, 180.0)])
def test_a_phase_over_540_degrees_has_fewer_labels(least, step):
    """If a phase turns by 540° or more, only every second multiple of 90° is labelled."""
    response = response_of(2, 2)
    phase = np.radians(np.linspace(0.0, least, response.omega.size))
    with drawing():
        figure, (ax,) = panels(0.8)
        plot_phase(ax, replace(response, phase=phase), chain=None)
    assert np.diff(sorted(labels(figure, ax))).tolist() == [step] * int(-least / step)


def labels(figure: Figure, ax: Axes) -> list[float]:
    """Return the numbers at the ticks of the vertical axis."""
    drawn(figure)
    low, high = ax.get_ylim()
    seen = [text for text in ax.get_yticklabels() if low <= text.get_position()[1] <= high]
    return [float(text.get_text().replace("−", "-")) for text in seen]


def test_carts_of_a_step_have_different_markers():
    """In the figure of a step, each cart has its own marker, also in the legend and caption."""
    analysis = make_analysis(3)
    run = analysis.step_gains[0].experiment
    gains = [gain for gain in analysis.step_gains if gain.experiment == run]
    (record,) = (record for record in analysis.records if record.id == run)
    with drawing():
        figure = step_figure([gains], records=[record], position_unit="cm")
    lines = figure.axes[0].get_lines()
    marks = {str(line.get_label()): line.get_marker() for line in lines}
    assert [marks[name] for name in ("x₁", "x₂", "x₃")] == [mark for _, _, mark, _ in CARTS[:3]]
    (picture,) = pictures(step_blocks(Page(analysis))).values()
    said = re.findall(r"(\w+): cart (\d)", plain(picture.caption))
    assert said == [("Circles", "1"), ("Squares", "2"), ("Triangles", "3")]


@pytest.mark.parametrize("points", [[10.0], [1.0, 9.0, 9.5, 4.0], [3.0] * 40])
def test_the_count_axis_has_only_whole_numbers(points):
    """The count axis of a histogram has only whole numbers."""
    with drawing():
        figure = distribution_figure(points, out_of=10.0)
    numbers = labels(figure, figure.axes[0])
    assert len(numbers) >= 2
    assert all(number.is_integer() for number in numbers)


# ------------------------------------------------------------ fitted recordings


def points_of(ax: Axes) -> list[np.ndarray]:
    """Return the measured points (n, 2) of each series that a panel shows."""
    dots = [patch for patch in ax.get_children() if type(patch) is PathPatch]
    return [np.asarray(patch.get_path().vertices)[::2] for patch in dots]


def line_named(ax: Axes, name: str) -> Any:
    """Return the line with points that has a name in the legend."""
    (line,) = (one for one in ax.lines if one.get_label() == name and np.size(one.get_xdata()))
    return line


def swept(n: int = 4000) -> Record:
    """Return a sweep of two carts whose swing is largest between 20 and 24 s."""
    t = np.linspace(0.0, 40.0, n)
    y = np.exp(-(((t - 22.0) / 4.0) ** 2)) * np.sin(2 * np.pi * t * (0.5 + t / 40.0))
    return Record(
        id="sweep", kind="sweep", t=t, u=np.sin(t), y=np.array([y, 0.5 * y]), carts=(1, 2),
        free=(1, 2), resolution=np.zeros(2),
    )  # fmt: skip


def test_fitted_steps_have_the_models_line_over_few_points():
    """The model's line of each cart is drawn as it is, over at most 120 measured points."""
    analysis = make_analysis(3)
    run = analysis.step_gains[0].experiment
    gains = [gain for gain in analysis.step_gains if gain.experiment == run]
    (record,) = (record for record in analysis.records if record.id == run)
    model = {cart: record.position(cart) + 0.01 for cart in record.carts}
    with drawing():
        figure = step_figure([gains], records=[record], position_unit="cm", models={run: model})
    (ax,) = figure.axes
    shown = points_of(ax)
    assert len(shown) == 3
    for cart, points in zip(record.carts, shown, strict=True):
        assert 60 < len(points) <= 120
        at = np.searchsorted(record.t, points[:, 0] - 1e-9)
        assert_allclose(points[:, 1], record.position(cart)[at])
        line = line_named(ax, f"x{'₁₂₃'[cart - 1]}")
        assert (line.get_color(), line.get_linestyle()) == CARTS[cart - 1][:2]
        assert line.get_zorder() > 1.9  # the points
        expected = np.interp(data(line, "x"), record.t, model[cart])
        assert_allclose(data(line, "y"), expected, atol=1e-9)


def test_a_fitted_sweep_shows_its_residual_and_its_largest_swing():
    """Left: the whole sweep and its residual. Right: the cycles of the largest swing, legibly."""
    record = swept()
    model = {1: record.position(1) - 0.1, 2: record.position(2) + 0.2}
    with drawing():
        figure = sweep_figure(record, model=model, position_unit="cm")
    assert len(figure.axes) == 4
    for cart, residual in ((1, 0.1), (2, -0.2)):
        whole, near = figure.axes[2 * cart - 2 : 2 * cart]
        assert_allclose(data(line_named(whole, "residual"), "y"), residual)
        assert np.ptp(data(line_named(whole, "motion"), "x")) > 39.0
        (points,) = points_of(near)
        assert points[0, 0] < 22.0 < points[-1, 0]
        assert len(points) <= 200
        line = line_named(near, "model")
        assert_allclose(np.ptp(data(line, "x")), np.ptp(points[:, 0]), rtol=0.02)
        crossings = np.count_nonzero(np.diff(np.signbit(points[:, 1])))
        assert 15 <= crossings <= 25  # ten cycles


def fitted_to(kind: str, *, method: str) -> Analysis:
    """Return an analysis of two carts whose model was fitted to recordings of a kind."""
    analysis = make_analysis(2)
    assert analysis.fit is not None
    sweep = replace(next(r for r in analysis.records if r.kind == "step"), id="sweep", kind="sweep")
    records = (*analysis.records, sweep)
    runs = tuple(record.id for record in records if record.kind == kind)
    fit = replace(analysis.fit, method=method, experiments=runs)
    return replace(analysis, records=records, fit=fit)


@pytest.mark.parametrize("method", ["time_fit", "bode_fit"])
def test_only_a_fit_to_recordings_is_drawn_over_them(method):
    """Steps and sweeps have the model's line only if the model was fitted to these recordings."""
    is_fitted = method == "time_fit"
    steps = pictures(step_blocks(Page(fitted_to("step", method=method))))["steps"]
    assert ("Lines: the model" in plain(steps.caption)) == is_fitted
    sweeps = pictures(sweep_blocks(Page(fitted_to("sweep", method=method))))
    assert [*sweeps] == (["sweep"] if is_fitted else [])


def test_a_fitted_step_without_a_gain_is_drawn():
    """A step that is too short for a static gain is drawn if the model was fitted to it."""
    analysis = replace(fitted_to("step", method="time_fit"), step_gains=())
    assert [*pictures(step_blocks(Page(analysis)))] == ["steps"]


# ------------------------------------------------------------ many closed loops


def looped(*shares: float) -> Analysis:
    """Return an analysis of two carts with a closed-loop run for each difference."""
    analysis = make_analysis(2)
    checks = [
        replace(check, experiment=f"loop-{i}", nrmse=share * (1.0 if check.cart == 1 else 0.5))
        for i, share in enumerate(shares)
        for check in analysis.hardware
    ]
    return replace(analysis, hardware=tuple(checks))


@pytest.mark.parametrize("shares", [(0.3,), (0.3, 0.1), (0.2, 0.1, 0.4, 0.3, 0.15, 0.25, 0.2)])
def test_closed_loops_have_one_figure_and_a_row_for_each_run(shares):
    """However many runs there are, one figure shows the worst and the best; the table has all."""
    analysis = looped(*shares)
    table, *others = hardware_blocks(Page(analysis))
    (picture,) = pictures(others).values()
    assert isinstance(table, Table)
    runs = [plain(row[0].text) for row in table.rows]
    simulations = {(check.experiment, check.loop) for check in analysis.hardware}
    many = len(shares) > 2
    assert len(runs) == len(simulations) * (1 if many else 2)
    assert {*runs} == {check.experiment for check in analysis.hardware}
    assert f"loop-{int(np.argmax(shares))}" in plain(picture.caption)
    if len(shares) > 1:
        assert f"loop-{int(np.argmin(shares))}" in plain(picture.caption)
        assert f"loop-{int(np.argmin(shares))}" in picture.svg


def test_a_model_looks_the_same_in_both_runs():
    """In a figure of two runs, the model on the measured input has one style, also if alone."""
    loop = make_analysis(1).hardware[0]
    check = replace(loop, loop="open", model=loop.model + 0.1)
    runs = [HardwareRun(name="a", checks=[check]), HardwareRun(name="b", checks=[loop, check])]
    with drawing():
        figure = hardware_figure(runs, units=PAPER_UNITS)
    left, right = (line_named(ax, "model on measured input") for ax in figure.axes[:2])
    assert (left.get_color(), left.get_linestyle()) == (right.get_color(), right.get_linestyle())
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert {"loop model", "model on measured input"} <= {t.get_text() for t in legend.get_texts()}


@pytest.mark.parametrize(("scale", "used"), [(1.01, False), (1.3, False), (-3.5, True)])
def test_the_table_says_whether_an_input_factor_was_used(scale, used):
    """A factor on the logged input has a column, which says whether the simulation used it."""
    analysis = make_analysis(1)
    checks = [replace(c, input_scale=scale, is_scaled=used) for c in analysis.hardware]
    table, _ = hardware_blocks(Page(replace(analysis, hardware=tuple(checks))))
    assert isinstance(table, Table)
    shown = [plain(row[7].text) for row in table.rows if len(row) > 7]
    assert shown == ([] if scale == 1.01 else [significant(scale, digits=3) + ", used" * used])
