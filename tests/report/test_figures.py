"""Figures have the right content and ticks, and the same data give the same bytes."""

import re
import subprocess
import sys
from base64 import b64decode
from dataclasses import replace
from itertools import combinations
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from numpy.testing import assert_array_equal

from pipeline.plant.chain import Chain
from pipeline.report.document import Picture
from pipeline.report.figures.bode import bode_figure, overview_figure, plot_phase
from pipeline.report.figures.colours import CARTS, MEASURED, QUIET
from pipeline.report.figures.grading import distribution_figure
from pipeline.report.figures.style import (
    drawing,
    panels,
    plot_measured,
    plot_model,
    plot_points,
    small_multiples,
    thin,
)
from pipeline.report.figures.svg import plain_svg, to_svg
from pipeline.report.figures.ticks import linear_ticks, log_ticks, tick_labels
from pipeline.report.figures.time import (
    damping_figure,
    decay_figure,
    design_figure,
    hardware_figure,
    sine_figure,
    step_figure,
)
from pipeline.report.sections.measurements import response_blocks, step_blocks
from pipeline.report.sections.page import Page
from pipeline.results import FrequencyResponse
from pipeline.setup import PAPER_UNITS, Units
from pipeline.words.numbers import significant
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis

COUNTS = Units(position="count", input="V")
SVG = "{http://www.w3.org/2000/svg}"


def bode_svg(carts: int = 2) -> str:
    analysis = make_analysis(carts)
    with drawing():
        figure = bode_figure(
            analysis.frequency_responses[0],
            chain=analysis.chain,
            units=PAPER_UNITS,
        )
        return to_svg(figure, name="bode", alt="Bode <plot>")


def test_a_figure_is_valid_svg_with_a_text_alternative():
    """The SVG of a figure is valid, has a text alternative, and its labels are text.

    Each of the 24 dwells is a diamond in all three panels; the legend has one more.
    """
    root = ElementTree.fromstring(bode_svg())
    assert len(list(root.iter(f"{SVG}use"))) == 3 * 24 + 1
    assert root.attrib["role"] == "img"
    assert root.findtext(f"{SVG}title") == "Bode <plot>"
    texts = ["".join(text.itertext()) for text in root.iter(f"{SVG}text")]
    assert "ω [rad/s]" in texts
    assert "|X₁/U| [dB re 1 cm/V]" in texts
    assert root.find(f"{SVG}metadata") is None


def test_a_measured_phase_is_drawn_near_the_models():
    """A measured phase is shifted by full turns so that it is drawn near the model's phase."""
    analysis = make_analysis(3)
    response = analysis.frequency_responses[2]  # the phase of cart 3 goes down to -540°
    with drawing():
        figure = bode_figure(response, chain=analysis.chain, units=PAPER_UNITS)
    _, phase, _ = figure.axes
    line, points = (np.asarray(drawn.get_ydata(), dtype=float) for drawn in phase.lines[:2])
    assert response.phase is not None
    assert np.min(response.phase) > -np.pi
    assert line.min() < -500
    # With noise of 0.01 rad and 300 points on the line, the difference is well below 15°.
    at = np.interp(response.omega, np.asarray(phase.lines[0].get_xdata(), dtype=float), line)
    assert np.max(np.abs(points - at)) < 15


def test_an_infinite_peak_does_not_hide_the_measurement():
    """If undamped carts have infinite peaks, the axis ends at most 50 dB above the measurement."""
    chain = Chain(m=np.array([1.0]), c=np.zeros(1), k=np.array([4.0, 0.0]))
    omega = np.array([0.5, 1.0, 3.0, 4.0])
    magnitude = np.abs(chain.frequency_response(omega)[0])
    response = FrequencyResponse(
        cart=1,
        omega=omega,
        magnitude=magnitude,
        magnitude_std=0.01 * magnitude,
        phase=np.zeros(4),
        phase_std=np.full(4, 0.01),
        source="dwells",
    )
    with drawing():
        figure = bode_figure(response, chain=chain, units=PAPER_UNITS)
        ElementTree.fromstring(to_svg(figure, name="x", alt=""))
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
        with drawing():
            figure = hardware_figure(
                [[replace(check, model=model)]], record=None, units=PAPER_UNITS
            )
            to_svg(figure, name="x", alt="")
        low, high = figure.axes[0].get_ylim()
        assert high - low <= 3.01 * np.ptp(check.measured)


def test_a_zero_in_a_table_of_ratios_is_left_out():
    """A zero in a table of ratios is omitted from the logarithmic plot; other points are drawn."""
    (response,) = make_analysis(1).frequency_responses
    magnitude = response.magnitude.copy()
    magnitude[3] = 0.0
    with drawing():
        figure = bode_figure(
            replace(response, magnitude=magnitude, phase=None, phase_std=None),
            chain=None,
            units=PAPER_UNITS,
        )
        root = ElementTree.fromstring(to_svg(figure, name="x", alt=""))
    assert len(list(root.iter(f"{SVG}use"))) == 23 + 1  # and one diamond in the legend


def _faint_and_far(cart: int) -> FrequencyResponse:
    """Return a response with one point of noise far off the fit, and one clear point far off."""
    response = make_analysis(3).frequency_responses[cart - 1]
    magnitude, std = response.magnitude.copy(), response.magnitude_std.copy()
    magnitude[-1] *= 1e4  # an amplitude of noise alone, where the carts hardly move
    std[-1] = 0.6 * magnitude[-1]
    magnitude[5] *= 1.8
    return replace(response, magnitude=magnitude, magnitude_std=std)


@pytest.mark.parametrize("cart", [1, 2, 3])
def test_points_without_signal_are_grey_and_not_counted(cart):
    """A point within the noise is grey in every panel, and the caption only counts it."""
    response, analysis = _faint_and_far(cart), make_analysis(3)
    with drawing():
        figure = bode_figure(response, chain=analysis.chain, units=PAPER_UNITS)
    for ax in figure.axes:
        drawn = [line for line in ax.lines if line.get_marker() == "D"]
        measured, faint = drawn
        assert measured.get_color() == MEASURED
        assert faint.get_color() == QUIET
        assert_array_equal(faint.get_xdata(), response.omega[-1:])
        assert_array_equal(measured.get_xdata(), response.omega[:-1])
    page = Page(replace(analysis, frequency_responses=(response,)))
    (picture,) = (block for block in response_blocks(page) if isinstance(block, Picture))
    caption = plain(picture.caption)
    assert f"at {significant(response.omega[5], digits=3)} rad/s" in caption  # the farthest point
    assert "Grey: 1 point with an amplitude within the noise" in caption
    assert re.search(r"rad/s, lies (79|8\d) % above it", caption)  # 80 %, and 1 % of noise
    assert f"to {significant(response.omega[-2], digits=3)} rad/s" in picture.alt


@pytest.mark.parametrize("factor", [0.2, 1.8, 300.0])
def test_the_residual_axis_is_clipped_with_a_mark(factor):
    """A far point does not hide the others: the axis is clipped, and a triangle marks the point."""
    analysis = make_analysis(3)
    response = analysis.frequency_responses[0]
    magnitude = response.magnitude.copy()
    magnitude[5] *= factor
    with drawing():
        figure = bode_figure(
            replace(response, magnitude=magnitude), chain=analysis.chain, units=PAPER_UNITS
        )
    residual = figure.axes[-1]
    low, high = residual.get_ylim()
    points = np.asarray(residual.lines[1].get_ydata(), dtype=float)
    outside = np.abs(points) > high
    assert_array_equal(np.flatnonzero(outside), [5])
    (mark,) = (line for line in residual.lines if line.get_marker() in ("^", "v"))
    assert mark.get_marker() == ("^" if factor > 1 else "v")
    assert_array_equal(mark.get_xdata(), response.omega[5:6])
    assert low < float(np.asarray(mark.get_ydata())[0]) < high
    # The limit is 30 medians and a margin of 15 %; the test's median includes the far point.
    assert 25.0 * np.median(np.abs(points)) < high < 40.0 * np.median(np.abs(points))


def test_residuals_without_a_far_point_are_all_shown():
    """Without far points the axis is not clipped and nothing is marked."""
    for carts in (1, 2, 3):
        analysis = make_analysis(carts)
        for response in analysis.frequency_responses:
            with drawing():
                figure = bode_figure(response, chain=analysis.chain, units=PAPER_UNITS)
            residual = figure.axes[-1]
            assert not [line for line in residual.lines if line.get_marker() in ("^", "v")]
            low, high = residual.get_ylim()
            points = np.asarray(residual.lines[1].get_ydata(), dtype=float)
            assert low < points.min()
            assert points.max() < high


def test_a_dwell_shades_the_transient():
    """The figure of a dwell shades the transient up to the start of the steady part."""
    analysis = make_analysis(2)
    points = [p for p in analysis.sine_points if p.experiment == "sine-10"]
    record = next(r for r in analysis.records if r.id == "sine-10")
    with drawing():
        figure = sine_figure(points, record=record, position_unit="cm")
    for ax in figure.axes:
        (span,) = (patch for patch in ax.patches if isinstance(patch, Rectangle))
        span = span.get_extents().transformed(ax.transData.inverted())
        assert span.x0 == pytest.approx(0.0, abs=1e-9)
        assert span.x1 == pytest.approx(4.0)


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


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 9))
def test_ticks_are_round_numbers_inside_the_axis(low, span, most):
    """An axis has at least two ticks, evenly spaced by 1, 2 or 5 times a power of ten.

    No tick is outside the axis.
    """
    high = low + span
    assume(span > 1e-9 * abs(low))
    ticks = linear_ticks(low, high, most=most)
    step = ticks[1] - ticks[0]
    assert ticks.size >= 2
    assert ticks[0] >= low - 1e-8 * step
    assert ticks[-1] <= high + 1e-8 * step
    mantissa = step / 10.0 ** np.floor(np.log10(step * (1 + 1e-6)))
    # Rounding: the step is a difference of numbers up to 1e9 times larger.
    assert min(abs(mantissa - m) for m in (1, 2, 5)) < 1e-5 * (1 + abs(low) / step * 1e-9)


def test_tick_labels_share_their_decimals():
    """All labels of an axis have the same number of decimals and a true minus sign."""
    assert tick_labels(np.array([-0.5, 0.0, 0.5])) == ["−0.5", "0.0", "0.5"]
    assert tick_labels(np.array([-200.0, 0.0])) == ["−200", "0"]
    assert tick_labels(log_ticks(0.4, 7.0)) == ["0.5", "1", "2", "5"]
    assert tick_labels(log_ticks(8.0, 27.0)) == ["10", "15", "20"]
    assert tick_labels(log_ticks(0.05, 900.0)) == ["0.1", "1", "10", "100"]
    assert tick_labels(np.array([0.0, 5e-6])) == ["0", "5e−06"]


def test_the_users_matplotlib_settings_do_not_matter(monkeypatch):
    """The user's own matplotlib settings change no figure."""
    import matplotlib

    before = bode_svg()
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "svg.fonttype": "path"}):
        assert bode_svg() == before


def test_the_report_imports_only_what_it_needs():
    """The report imports neither pyplot nor pandas nor python-control, to save a second."""
    code = (
        "import sys, pipeline.report.render.write; "
        "print([m for m in ('matplotlib.pyplot', 'pandas', 'control', 'numba', 'scipy.signal') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


_TOUCH = 2.0  # points by which two boxes may overlap, since letters do not fill their boxes


def figures_of(carts: int) -> dict[str, Figure]:
    """Return a figure of each kind in a report; the names of the recordings are long."""
    analysis = make_analysis(carts)
    records = {r.id: replace(r, id=f"{r.id} the second try of Tuesday") for r in analysis.records}
    long = {id_: record.id for id_, record in records.items()}
    decays = [replace(d, experiment=long[d.experiment]) for d in analysis.log_decrements]
    own = [decay for decay in decays if decay.cart == 1]
    runs = list(dict.fromkeys(gain.experiment for gain in analysis.step_gains))
    dwell = analysis.sine_points[-1].experiment
    checks = [[c for c in analysis.hardware if c.cart == cart] for cart in range(1, carts + 1)]
    assert analysis.feedback is not None
    return {
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
        "hardware": hardware_figure(
            checks, record=analysis.records[-1], units=COUNTS
        ),
        "overview": overview_figure(
            analysis.frequency_responses, chain=analysis.chain, units=COUNTS,
        ),
        "feedback": design_figure(analysis.feedback, units=COUNTS),
    }  # fmt: skip


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_no_text_of_a_figure_is_cut_or_covered(carts):
    """All text in a figure lies on the canvas, and no two texts overlap."""
    with drawing():
        for name, figure in figures_of(carts).items():
            to_svg(figure, name=name, alt="")  # draws the ticks
            canvas = FigureCanvasAgg(figure)
            renderer = canvas.get_renderer()
            canvas.draw()
            texts = [
                text for text in figure.findobj(Text)
                if isinstance(text, Text) and text.get_visible() and text.get_text()
            ]  # fmt: skip
            boxes = [(t.get_text(), t.get_window_extent(renderer)) for t in texts]
            assert len(boxes) > 8
            for text, box in boxes:
                inside = min(box.min) >= 0 and bool(np.all(box.max <= figure.bbox.max))
                assert inside, (name, text)
            for (text, box), (other, near) in combinations(boxes, 2):
                apart = np.maximum(box.min, near.min) >= np.minimum(box.max, near.max) - _TOUCH
                assert apart.any(), (name, text, other)


def test_a_figure_on_the_page_has_all_its_data():
    """On the page, a figure stores every measured point; a plain SVG has only the points drawn."""
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 9.0, 5001)
    y = rng.normal(size=t.size)
    uneven = np.sort(rng.uniform(0.0, 9.0, 40))
    with drawing():
        figure, (ax,) = panels(1.0)
        plot_measured(ax, t, y)
        plot_model(ax, uneven, np.sin(uneven), label="\"quoted\" <b> 'model'")
        svg = to_svg(figure, name="x", alt="")

    series = [g.attrib for g in ElementTree.fromstring(svg).iter() if "data-x" in g.attrib]
    model, measured = sorted(series, key=lambda attributes: attributes["data-name"])
    assert measured["data-name"] == "measured"
    assert measured["data-x"] == "0 9"
    # The numbers are stored as float32.
    np.testing.assert_allclose(unpacked(measured["data-y"]), y, rtol=1e-6)
    assert model["data-name"] == "\"quoted\" <b> 'model'"
    np.testing.assert_allclose(unpacked(model["data-x"]), uneven, rtol=1e-6)
    assert "data-" not in plain_svg(svg)
    assert len(plain_svg(svg)) < 40_000


def unpacked(text: str) -> np.ndarray:
    return np.frombuffer(b64decode(text), dtype="<f4")


def test_repeats_share_one_time_axis():
    """Panels of repeated runs share one time axis; each panel has a title."""
    with drawing():
        figure, axes = small_multiples(list("abcde"), height=1.0, share_y=True)
        axes[0].set_xlim(0, 3)
    assert len(axes) == 5
    assert len({ax.get_xlim() for ax in axes}) == 1
    assert len({round(ax.get_position().x0, 6) for ax in axes}) == 3
    assert [ax.get_title(loc="left") for ax in axes] == list("abcde")
    assert len(figure.axes) == 5


def test_a_phase_over_540_degrees_has_fewer_labels():
    """If a phase turns by 540° or more, only every second multiple of 90° is labelled."""
    for least, step in ((-360.0, 90.0), (-540.0, 180.0)):
        response = make_analysis(2).frequency_responses[1]
        phase = np.radians(np.linspace(0.0, least, response.omega.size))
        figure, (ax,) = panels(0.8)
        with drawing():
            plot_phase(ax, replace(response, phase=phase), chain=None)
            to_svg(figure, name="x", alt="")
        texts = [text.get_text() for text in ax.texts if text.get_gid() == "tick-y"]
        ticks = sorted(float(text.replace("−", "-")) for text in texts)
        assert np.diff(ticks).tolist() == [step] * int(-least / step)


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
    (picture,) = (b for b in step_blocks(Page(analysis)) if isinstance(b, Picture))
    assert "Circles: cart 1. Squares: cart 2. Triangles: cart 3." in plain(picture.caption)


@pytest.mark.parametrize("points", [[10.0], [1.0, 9.0, 9.5, 4.0], [3.0] * 40])
def test_the_count_axis_has_only_whole_numbers(points):
    """The count axis of a histogram has only whole numbers."""
    with drawing():
        figure = distribution_figure(points, out_of=10.0)
        to_svg(figure, name="x", alt="")
    (ax,) = figure.axes
    texts = [text.get_text() for text in ax.texts if text.get_gid() == "tick-y"]
    assert len(texts) >= 2
    assert all(text.isdigit() for text in texts)


def test_long_titles_are_shortened_to_their_differences():
    """If long names of runs begin with the same words, only the part that differs is shown."""
    names = [f"DOF1_en1_input1_trial_of_monday_{i}" for i in range(6)]
    with drawing():
        _, axes = small_multiples(names, height=1.0, share_y=True)
    assert [ax.get_title(loc="left") for ax in axes] == [f"…{i}" for i in range(6)]
    with drawing():
        _, axes = small_multiples(["step-1", "step-2"], height=1.0, share_y=True)
    assert [ax.get_title(loc="left") for ax in axes] == ["step-1", "step-2"]
