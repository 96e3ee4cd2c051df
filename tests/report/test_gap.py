"""The gap report, its file and its summary in the main report are right for all verdicts."""

import json
import re
from dataclasses import replace
from functools import cache
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pypdf
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.testing import assert_allclose
from typer.main import get_command

from pipeline.cli import app
from pipeline.errors import ConfigError
from pipeline.experiments.plan import Recording
from pipeline.gap.residual import residual_forces
from pipeline.gap.types import (
    Alternative,
    AlternativeModel,
    Gap,
    Prediction,
    Proposal,
    Trace,
    Verdict,
    read_gap,
)
from pipeline.json_files import json_text
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.effect import AugmentedChain, effect_name, input_steps
from pipeline.plant.simulator.generated_forces import shaped_input
from pipeline.report.builder import Page as ReportPage
from pipeline.report.document import (
    Document,
    Formula,
    Picture,
    Table,
    paragraph,
    plain_lines,
)
from pipeline.report.equations.model import augmented_equations, in_order, law
from pipeline.report.figures.gap import predicted_figure
from pipeline.report.files import write_files
from pipeline.report.gap_files import with_gap
from pipeline.report.gap_report import (
    LEGEND,
    _telling_first,
    augmented_hardware_blocks,
    build_gap_document,
    make_gap_files,
)
from pipeline.report.gap_verdict import WORDS, added_name, kept_together, share, terminal_verdict
from pipeline.report.html import render_html
from pipeline.report.lab_report import build_document
from pipeline.submission import load_submission
from pipeline.words.math import to_text
from pipeline.words.text import plain
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.effects import make_term
from tests.helpers.gaps import CHAIN, RESIDUAL, T, U, make_gap, two_cart_analysis, usual_terms
from tests.helpers.pages import HOSTILE, Page, pictures, rows, sections, tiles
from tests.helpers.time_records import write_records
from tests.truth.cases import make_case

SUSPECT = Alternative(effect=find_effect("backlash"), where={}, nrmse_after=0.12, confidence=0.9)
NAMES = {
    key: effect_name(find_effect(key), {"cart": 2})
    for key in ("coulomb_friction", "quadratic_drag")
}


@cache
def document_of(verdict: Verdict, *keys: str) -> Document:
    """Return the gap report of a constructed gap."""
    return build_gap_document(make_gap(verdict, keys), two_cart_analysis())


def page_of(gap: Gap) -> Page:
    """Return the parsed page of a gap report, with the text of its figures."""
    return Page(render_html(build_gap_document(gap, two_cart_analysis())))


@pytest.mark.parametrize(
    ("verdict", "keys", "more", "tones"),
    [
        ("named", ("coulomb_friction",), "effect-1 model", ["", "good", ""]),
        ("ambiguous", ("coulomb_friction",), "effect-1 apart model", ["", "", ""]),
        ("partial", ("coulomb_friction",), "effect-1 force-left model", ["", "bad", ""]),
        ("unexplained", ("coulomb_friction",), "effect-1 force-left model", ["", "bad", ""]),
        ("unexplained", (), "force-left", ["bad", ""]),
    ],
)
def test_each_verdict_has_its_sections_and_errors(verdict, keys, more, tones):
    """Title, sections, errors and their colours follow from the verdict."""
    found = sections(document_of(verdict, *keys))
    assert found["summary"].title == WORDS.text(f"title_{verdict}")
    always = {"summary", "where", "method", "provenance"}
    assert found.keys() - {"runs", "warnings"} == always | {*more.split()}
    board = tiles(found["summary"].blocks)
    errors = [0.153, 0.041, 0.03] if keys else [0.153, 0.03]
    assert [plain(tile.value) for tile in board] == [share(error) for error in errors]
    assert [tile.tone for tile in board] == tones
    # The figures call the model as the verdict does, and draw no model with effects without one.
    name = added_name(make_gap(verdict, keys))
    drawn = Page(render_html(document_of(verdict, *keys))).text
    other = {WORDS.text("with_effects"), WORDS.text("with_suspects")} - {name}
    assert bool(name) == bool(keys)
    assert name in drawn
    assert not any(one in drawn for one in other)


def test_the_summary_names_effects_sizes_and_errors():
    """The terminal's summary has each name with its errors; a suspect is not an explanation."""
    said = {verdict: terminal_verdict(make_gap(verdict)) for verdict in ("named", "ambiguous")}
    for text in said.values():
        assert NAMES["coulomb_friction"][1:] in text
        assert all(share(error) in text for error in (0.153, 0.041, 0.03))
    assert NAMES["quadratic_drag"] in said["ambiguous"]
    assert NAMES["quadratic_drag"] not in said["named"]
    gap = replace(make_gap("unexplained", ()), final=0.153, suspects=(SUSPECT,))
    name, error = effect_name(SUSPECT.effect, {}), share(SUSPECT.nrmse_after)
    assert re.search(rf"{name} \([^)]*{error}\)", terminal_verdict(gap))
    assert read_gap(json_text(gap)).suspects == gap.suspects
    repeated = replace(make_gap(), repeatability=0.035)
    assert WORDS.text("repeats_differ", share=share(0.035)) in terminal_verdict(repeated)


def test_each_force_is_given_with_its_cart():
    """If both carts have dry friction, each force is given with its cart, and the law once."""
    gap = make_gap()
    (one,) = gap.effects
    said = terminal_verdict(replace(gap, effects=(replace(one, where={"cart": 1}), one)))

    carts = re.findall(r"on cart (\d): force [^;\n]+\sV\.", said)
    assert carts == ["1", "2"]
    assert said.count(one.effect.sentence) == 1


def test_where_the_error_is_left_is_said():
    """A partial verdict says how much error is left and where, also if it is spread evenly."""
    gap = replace(make_gap("partial"), noise_floor=0.01)
    (window,) = gap.left
    for what in (window.what, "throughout"):
        said = terminal_verdict(replace(gap, left=(replace(window, what=what),)))
        for fact in ("4.1 times", "step-b, cart 2", "2.00 to 2.60"):
            assert fact in said
        assert (what in said) == (what != "throughout")
    only_noise = terminal_verdict(replace(gap, verdict="ambiguous", noise_floor=gap.final))
    assert "2.00 to 2.60" not in only_noise


def test_the_verdict_none_says_what_it_covers():
    """If no effect is needed, the page says how far the carts moved and what could be hidden."""
    gap = replace(make_gap("none", ()), final=0.031, baseline=0.031, where=())
    found = sections(build_gap_document(gap, two_cart_analysis()))

    assert not found.keys() & {"effect-1", "model", "apart", "force-left"}
    assert [tile.tone for tile in tiles(found["summary"].blocks)] == ["good", ""]
    assert list(pictures(found["summary"].blocks)) == ["before-after-1"]
    said = plain_lines(found["summary"].blocks)
    far = {t.cart: np.abs(t.measured - t.zero).max() for t in gap.traces}  # of the last run
    numbers = [float(n) for n in re.findall(r"cart \d up to ([\d.]+)", said)]
    assert_allclose(numbers, [far[1], far[2]], rtol=0.02)  # three digits, and noise
    assert "0.0500 V" in said
    # A search begins at a chi-square of 1.15 per point. With noise of 3 %: 3 % √(1.15 - 1) = 1.2 %.
    assert re.search(r"1\.2 %", said)


@pytest.mark.parametrize(
    ("errors", "shown"),
    [
        # The linear model is worst in step-a, but there the effects change little.
        (
            {("step-a", 1): (0.9, 0.85), ("step-b", 1): (0.2, 0.15), ("step-b", 2): (0.5, 0.1)},
            [("step-b", 2), ("step-a", 1)],
        ),
        # Without effects, or if they make it worse, nothing is gained anywhere.
        ({("step-a", 1): (0.2, 0.2), ("step-b", 1): (0.9, 0.9)}, [("step-b", 1), ("step-a", 1)]),
        ({("step-a", 1): (0.2, 0.3), ("step-b", 1): (0.3, 0.3)}, [("step-b", 1), ("step-a", 1)]),
    ],
)
def test_the_run_shown_first_is_one_in_which_the_effects_act(errors, shown):
    """Of each held-out run, the cart is shown whose error falls most; the best run comes first."""
    gap = make_gap()
    (trace, *_), (row, *_) = gap.traces, gap.by_record
    gap = replace(
        gap,
        traces=tuple(replace(trace, experiment=run, cart=cart) for run, cart in errors),
        by_record=tuple(
            replace(row, experiment=run, cart=cart, baseline=before, final=after)
            for (run, cart), (before, after) in errors.items()
        ),
    )

    found = _telling_first(gap)

    assert [(one.experiment, one.cart) for one in found] == shown
    first = pictures(sections(build_gap_document(gap, two_cart_analysis()))["summary"].blocks)
    assert f"Cart {shown[0][1]} in {shown[0][0]}" in plain(first["before-after-1"].caption)


def test_the_unexplained_force_has_a_figure_and_a_formula():
    """The unexplained force is drawn for each cart, with a formula that is not in the catalogue."""
    assert RESIDUAL.formula is not None
    for keys in ((), ("coulomb_friction",)):
        blocks = sections(document_of("unexplained", *keys))["force-left"].blocks
        assert list(pictures(blocks)) == ["force-left-2"]
        assert RESIDUAL.formula.text in plain_lines(blocks)


def test_an_answer_at_the_time_limit_is_called_the_best_so_far():
    """If the time budget ended the search, the page calls its result the best answer so far."""
    so_far = paragraph(WORDS.spans("so_far"))
    for complete in (True, False):
        gap = replace(make_gap("unexplained", ()), complete=complete)
        found = sections(build_gap_document(gap, two_cart_analysis()))
        assert (so_far in found["summary"].blocks) != complete
        method = paragraph(WORDS.spans("method" if complete else "method_so_far"))
        assert method in found["method"].blocks


def test_effects_that_help_only_together_are_one_step():
    """If an effect helps only together with the next one, both share a row and their errors."""
    gap = make_gap("partial", ("coulomb_friction", "saturation", "dead_zone"))
    errors = (0.135, 0.0925, 0.0968, 0.0723)
    effects = tuple(
        replace(found, nrmse_before=before, nrmse_after=after)
        for found, before, after in zip(gap.effects, errors, errors[1:], strict=False)
    )
    friction, saturation, dead_zone = effects
    assert kept_together(effects) == [(friction,), (saturation, dead_zone)]
    found = sections(build_gap_document(replace(gap, effects=effects), two_cart_analysis()))

    shown = [errors for name, errors in rows(found["summary"].blocks).items() if "with" in name]
    assert [share(error) in row for error, row in zip((0.0925, 0.0723), shown, strict=True)] == [
        True, True,
    ]  # fmt: skip
    steps = [re.findall(r"[\d.]+ %", plain_lines(found[f"effect-{i}"].blocks)) for i in (1, 2, 3)]
    assert steps[0][:2] == ["13.5 %", "9.2 %"]
    assert steps[1][:3] == steps[2][:3] == ["9.2 %", "7.2 %", "9.7 %"]


@pytest.mark.parametrize("seen", [True, False])
def test_the_band_of_the_noise_is_mentioned_if_it_can_be_seen(seen):
    """A caption mentions the noise band only if the residuals are not much larger than the noise.

    If `seen` is true, both models leave only noise; otherwise the linear model's error is large.
    """
    gap = make_gap()
    if seen:
        gap = replace(gap, traces=tuple(replace(one, baseline=one.final) for one in gap.traces))
    found = sections(build_gap_document(gap, two_cart_analysis()))
    caption = plain(pictures(found["summary"].blocks)["before-after-1"].caption)
    assert (WORDS.text("band") in caption) == seen


# ------------------------------------------------------------------ two explanations

LINE = np.linspace(0.0, 1.0, 50)
PREDICTION = Prediction(
    pair=(0, 1), cart=2, t=LINE, u=LINE, positions=np.array([np.sin(LINE), np.cos(LINE)])
)
MANY = ("cogging", "drive_damping", "input_delay", "slack_spring", "coulomb_friction")


@pytest.mark.parametrize(
    ("first", "second", "only", "legend"),
    [
        (("coulomb_friction",), ("cogging", "coulomb_friction"), ("cogging",), "without it"),
        (
            ("end_stop", "coulomb_friction"),
            ("end_stop", "cubic_spring"),
            ("coulomb_friction", "cubic_spring"),
            "the second model",
        ),
        (("saturation",), ("saturation", *MANY), MANY, "without them"),
    ],
)
def test_two_models_are_named_by_their_differences(first, second, only, legend):
    """The text names the effects that only one model has, and the legend shows short names."""
    contenders = tuple(
        AlternativeModel(chain=CHAIN, terms=usual_terms(*keys), weight=0.5)
        for keys in (first, second)
    )
    recording = Recording(
        id="apart", kind="sweep", carts=(1, 2), wave="triangle", amplitude=0.6, frequency=0.12
    )
    proposal = Proposal(recording=recording, limits=None, separation=42.0, prediction=PREDICTION)
    gap = replace(make_gap("partial"), contenders=contenders, proposal=proposal)
    blocks = sections(build_gap_document(gap, two_cart_analysis()))["apart"].blocks

    said = plain_lines(blocks)
    for term in (*contenders[0].terms, *contenders[1].terms):
        name = effect_name(term.effect, term.where)
        assert (name in said) == (term.effect.key in only)
    assert f">{legend}</text>" in pictures(blocks)["predicted"].svg


def test_the_longest_names_in_a_legend_fit_in_the_figure():
    """Two names with the greatest length allowed in a legend still end inside the figure."""
    names = ("with a sensor with a scale", "without a dead zone.")
    assert len("".join(names)) == LEGEND
    figure = predicted_figure(PREDICTION, names=names, position_unit="cm")
    legend = figure.axes[0].get_legend()
    assert legend is not None
    box = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer())

    assert box.x1 < figure.bbox.x1


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_the_page_of_every_effect_is_complete(effect):
    """The page of every effect has its figure, its fingerprint and its reference."""
    document = document_of("named", effect.key)
    text = Page(render_html(document)).text

    assert effect.fingerprint in text
    assert effect.reference in text
    assert "\\" not in text
    assert not re.search(r"\b(None|nan|inf)\b", text)
    evidence = pictures(sections(document)["effect-1"].blocks)["effect-1"]
    assert effect.fingerprint in evidence.alt
    formulas = [b for s in document.sections for b in s.blocks if isinstance(b, Formula)]
    assert formulas
    assert all(formula.alt for formula in formulas)


# ------------------------------------------------------------------ equations


def laws_of(*keys: str) -> tuple[list[str], list[str]]:
    """Return the equations of motion and the law of each effect, as text without spaces."""
    terms = usual_terms(*keys)
    motion = to_text(augmented_equations((True, True, True), terms).math).split("; ")
    laws = [to_text(law(terms, index).math) for index in in_order(terms)]
    return motion, [text.replace(" ", "") for text in laws]


@pytest.mark.parametrize(
    "keys", list(permutations(("saturation", "actuator_lag", "dead_zone", "input_delay")))[::5]
)
def test_changes_of_the_input_are_applied_as_in_the_simulator(keys):
    """The input's changes are applied in the simulator's order, however the effects are listed.

    The input after the last change pushes cart 1 and enters the load-dependent friction.
    """
    (first, second), laws = laws_of(*keys, "load_friction")

    assert laws[:-1] == [
        "u_a=\u2009sign\u2009u·\u2009max(|u|−w,0)",
        "u_b=\u2009clip(u_a,−L,L)",
        "u_c(t)=u_b(t−T)",
        "τu′_d+u_d=u_c",
    ]
    assert laws[-1].startswith("f_e=−μ|u_d|")
    assert first.endswith("= u_d")
    assert second.endswith("= f_e")


def test_the_dead_zone_comes_before_the_saturation_in_the_simulator():
    """The simulator's input is clip(sign u · max(|u| − w, 0), −L, L), as the page says."""
    limit, width = 0.2, 0.3
    terms = (
        make_term(find_effect("saturation"), place=0, values={"limit": limit}, chain=CHAIN),
        make_term(find_effect("dead_zone"), place=0, values={"width": width}, chain=CHAIN),
    )
    drive = AugmentedChain(chain=CHAIN, terms=terms).tables().drive
    u = np.linspace(-0.8, 0.8, 33)

    # In the other order no input would remain, because the limit is below the width.
    expected = np.clip(np.sign(u) * np.maximum(np.abs(u) - width, 0.0), -limit, limit)
    assert_allclose([shaped_input(drive, one) for one in u], expected, atol=1e-15)
    assert [term.effect.key for term in input_steps(terms)] == ["dead_zone", "saturation"]


def test_forces_between_bodies_act_on_both():
    """Spring 2 pulls both of its carts; with backlash, the contact pushes cart 1 and the motor.

    The motor's mass is part of m_1, so it is subtracted on the right-hand side.
    """
    motion, laws = laws_of("backlash", "cogging", "input_delay", "drive_damping")
    assert motion[0].endswith("= f_a + m_mx″_1 + f_d")
    assert laws[0].endswith("m_mx″_m=u_c−f_a+f_b")
    assert "x_m/λ" in laws[1]
    spring = make_term(
        find_effect("cubic_spring"), place=2, values={"coefficient": 1.0}, chain=CHAIN
    )
    first, second = to_text(augmented_equations((True, True, True), (spring,)).math).split("; ")
    assert first.endswith("= u + f_a")
    assert second.endswith("= −f_a")
    assert to_text(law((spring,), 0).math) == "f_a = ad^3"


def test_a_model_of_many_effects_has_its_equations():
    """Each of a dozen effects has its own letter in the equations."""
    keys = ("saturation", "dead_zone", "input_delay", "actuator_lag", "cogging", "drive_damping",
            "coulomb_friction", "quadratic_drag", "cubic_spring", "slack_spring", "end_stop",
            "coupling_damper")  # fmt: skip
    named = [re.search("[uf]′?_(.)", text) for text in laws_of(*keys)[1]]
    assert [found and found[1] for found in named] == list("abcdefghijkl")


def test_every_command_on_the_page_can_be_copied(tmp_path):
    """Each command on the page is complete: parsing it raises no error."""
    commands = re.findall("`cartlab ([^`]+)`", WORDS.path.read_text(encoding="utf-8"))
    assert len(commands) == 3
    (tmp_path / "gap").mkdir()
    (tmp_path / "gap" / "gap.json").write_text("{}", encoding="utf-8")
    for command in commands:
        name, *args = command.replace("DIR", str(tmp_path)).split()
        group = get_command(app)
        group.commands[name].make_context(name, args)  # pyright: ignore[reportAttributeAccessIssue]


def test_pdf_and_files_are_the_same_each_time(tmp_path):
    """PDF and other files are the same each time; the PDF's first page has the verdict."""
    for name in ("one", "two"):
        made = make_gap_files(make_gap(), two_cart_analysis())
        write_files(made, tmp_path / name, name="gap")
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*.*"))
    assert {"gap.html", "gap.pdf"} < {str(file) for file in files}
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    first = pypdf.PdfReader(tmp_path / "one" / "gap.pdf").pages[0].extract_text()
    assert NAMES["coulomb_friction"][1:] in first


# ------------------------------------------------------------------ residual force


def test_residual_force_of_a_constant_force_is_that_force():
    """If a constant force pushes cart 2, the computed residual force equals this force."""
    pushed = make_term(find_effect("force_offset"), place=2, values={"force": 0.004}, chain=CHAIN)
    model = AugmentedChain(chain=CHAIN, terms=(pushed,))
    x = simulate_augmented(model, T, U)
    traces = tuple(
        Trace(experiment="a", cart=cart, held_out=True, t=T, u=U, measured=x[cart - 1],
              baseline=x[cart - 1], final=x[cart - 1])
        for cart in (1, 2)
    )  # fmt: skip
    first, second = residual_forces(
        replace(make_gap(), model=model, traces=traces), free={"a": (1, 2)}
    )

    # With 9 samples in a window, the estimate is exact for parabolas. The error is m x'''' T²/50;
    # since (18 rad/s · 0.07 s)²/50 is 3 %, it is at most 3 % of the forces of 0.05 V at the edges.
    assert_allclose(second.measured, 0.004, atol=0.03 * 0.05)
    assert_allclose(np.median(second.measured), 0.004, rtol=1e-3)
    assert_allclose(np.median(first.measured), 0.0, atol=1e-5)
    assert_allclose(first.measured, first.model)


def test_a_cart_beside_one_that_was_not_measured_has_no_residual_force():
    """If a cart's neighbour was not measured, the cart's residual force is not estimated."""
    gap = make_gap()
    alone = replace(gap, traces=tuple(t for t in gap.traces if t.cart == 1))

    assert residual_forces(alone, free={"step-a": (1, 2), "step-b": (1, 2)}) == ()
    assert len(residual_forces(alone, free={"step-a": (1,), "step-b": (1,)})) == 2


# --------------------------------------------------------------------- the file


@pytest.mark.parametrize(
    ("training", "held_out", "fails"), [(0.5, 0.5, True), (0.3, 0.5, False), (0.5, 0.3, False)]
)
def test_a_linear_model_that_fails_everywhere_is_called_so(training, held_out, fails):
    """It must fail where it was fitted as well: there, nothing beyond the recordings is asked."""
    gap = make_gap("unexplained", ())
    rows = tuple(
        replace(row, baseline=held_out if row.held_out else training) for row in gap.by_record
    )
    gap = replace(gap, baseline=held_out, final=held_out, by_record=rows)
    assert any(row.held_out for row in rows)
    assert not all(row.held_out for row in rows)
    assert (WORDS.text("title_no_model") in terminal_verdict(gap)) == fails


@pytest.mark.parametrize("verdict", ["named", "partial", "none", "ambiguous", "unexplained"])
def test_the_file_is_read_back_as_it_was(verdict):
    """A `gap.json` that is read and written again is the same, with the same verdict."""
    gap = make_gap(verdict, () if verdict == "none" else ("end_stop", "input_delay"))
    text = json_text(gap)

    again = read_gap(text)

    assert json_text(again) == text
    assert (again.provenance, again.bench) == (gap.provenance, gap.bench)
    assert terminal_verdict(again) == terminal_verdict(gap)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"schema": "cartlab-gap/2", "verdict": "named"}',
        '{"schema": "cartlab-gap/1", "verdict": "named", "gap": {}, "model": {}}',
        "[" * 200_000,
        '{"gap":' * 200_000,
    ],
)
def test_a_file_that_is_not_gap_json_is_refused(text):
    """A file that is not a `gap.json` is refused by one error without a traceback."""
    with pytest.raises(ConfigError, match=r"cartlab gap|cartlab-gap/1"):
        read_gap(text)


# ------------------------------------------------------- one whole run


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Write a submission of one cart with dry friction and run `cartlab gap` on it."""
    case = make_case(seed=41, n=1, effects=["coulomb_friction"], rate=113.1)
    # The last step is stated to be a closed loop, since its input was measured.
    records = [
        replace(one, kind="closed_loop", reference=np.zeros(one.t.size)) if one.id == "step-d"
        else one
        for one in case.records
        if one.id != "sweep"
    ]  # fmt: skip
    folder = write_records(tmp_path_factory.mktemp("bench"), records, carts=1)
    done = cartlab_here("gap", folder, "--json", "--model")
    (hidden,) = case.hidden
    return SimpleNamespace(folder=folder, done=done, force=hidden.parameters["force"])


def test_command_writes_everything_and_names_the_friction(bench):
    """`cartlab gap` ends with status 0, writes all files and names the hidden friction."""
    assert bench.done.returncode == 0, bench.done.stderr
    out = bench.folder / "gap"
    text = (out / "gap.json").read_text(encoding="utf-8")
    assert bench.done.stdout == text
    assert (out / "gap.pdf").read_bytes().startswith(b"%PDF")
    assert list((out / "figures").glob("effect-1.svg"))
    document = json.loads(text)
    assert document["verdict"] == "named"
    (effect,) = document["effects"]
    assert (effect["effect"], effect["where"]) == ("coulomb_friction", {"cart": 1})
    # The two simulators differ by about 1e-3 of the force; noise adds about as much.
    assert_allclose(effect["parameters"]["force"]["value"], bench.force, rtol=5e-3)
    assert effect["nrmse_after"] == document["gap"]["final"]
    assert set(document["chain"]) == {"m", "c", "k", "units"}
    assert document["springs"] == [True, True]
    assert set(document["provenance"]["files"]) == {
        f"data/{path.name}" for path in (bench.folder / "data").iterdir()
    }

    force = effect["parameters"]["force"]["value"]
    for name in ("model.c", "model.m"):
        assert f"coulomb_friction_1_force = {force}" in (out / name).read_text(encoding="ascii")


def test_many_closed_loops_are_one_figure_and_a_table():
    """The figure shows the recordings with the largest and the smallest error; the table all."""
    analysis = make_analysis(2)
    loop = next(record for record in analysis.records if record.kind == "closed_loop")
    checks = [replace(check, loop="open") for check in analysis.hardware]
    names = [f"loop-{i}" for i in range(5)]
    analysis = replace(
        analysis,
        records=tuple(
            replace(loop, id=name, y=scale * loop.y) for scale, name in enumerate(names, start=1)
        ),
        hardware=tuple(replace(check, experiment=name) for name in names for check in checks),
    )
    table, picture = augmented_hardware_blocks(
        ReportPage(analysis), make_gap("named", ("coulomb_friction",))
    )[1:]
    assert isinstance(table, Table)
    assert isinstance(picture, Picture)
    assert [plain(row[0].text) for row in table.rows] == [n for n in names for _ in checks]
    drawn = picture.svg
    assert [name for name in names if name in Page(drawn).text] == [names[0], names[-1]]


@pytest.mark.slow
@pytest.mark.sample
def test_report_shows_the_verdict_and_the_better_simulation(bench):
    """The report quotes the gap analysis of its data and simulates with the effects found."""
    analysis, gap = with_gap(analyse(load_submission(bench.folder)), bench.folder)
    assert gap is not None
    assert analysis.warnings == analyse(load_submission(bench.folder)).warnings

    document = build_document(analysis, gap=gap)
    page = Page(render_html(document))

    assert effect_name(find_effect("coulomb_friction"), {"cart": 1})[1:] in page.text
    linear, augmented = map(
        float, re.findall(r"step-d1(\d+(?:\.\d+)?) %(\d+(?:\.\d+)?) %", page.text)[-1]
    )
    # The fit did not use this run, so the error is only the encoder's rounding.
    assert augmented < 0.2 * linear
    links = {href[1:] for href in page.values("href") if href.startswith("#")}
    assert links <= set(page.values("id"))


def test_gap_analysis_of_other_data_is_only_a_warning(bench, tmp_path):
    """If the data have changed since the gap analysis, the report warns and does not quote it."""
    analysis = analyse(load_submission(bench.folder))
    changed = replace(analysis, files=analysis.files | {"data/step-a.csv": "0" * 64})

    warned, gap = with_gap(changed, bench.folder)

    assert gap is None
    assert "gap.json" in warned.warnings[-1]
    assert with_gap(analysis, tmp_path) == (analysis, None)
    for text in ("{", "[" * 200_000, " " * 20_000_000):
        (tmp_path / "gap.json").write_text(text, encoding="utf-8")
        assert "gap.json" in with_gap(analysis, tmp_path)[0].warnings[-1]


def test_hostile_text_in_a_gap_file_stays_text(bench):
    """Hostile text in a `gap.json` appears as plain text."""
    analysis = analyse(load_submission(bench.folder))
    text = (bench.folder / "gap" / "gap.json").read_text(encoding="utf-8")
    document = json.loads(text) | {"next_experiment": HOSTILE}
    gap = read_gap(json.dumps(document))

    page = Page(render_html(build_document(analysis, gap=gap)))

    assert (page.count("img"), page.count("iframe"), page.count("script")) == (0, 0, 1)
    assert "<script>alert(1)</script>" in page.text
