"""The gap report, its file and its summary in the main report are right for all verdicts."""

import json
import re
from dataclasses import replace
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pypdf
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.testing import assert_allclose
from typer.main import get_command

from pipeline.cli.commands import app
from pipeline.errors import ConfigError
from pipeline.gap.residual import residual_forces
from pipeline.gap.types import (
    Alternative,
    AlternativeModel,
    ForceAgainst,
    ForceFormula,
    FormulaTerm,
    FoundEffect,
    FreeRun,
    Gap,
    GapWindow,
    NamedValue,
    Prediction,
    Proposal,
    RecordGap,
    Residual,
    Trace,
    Verdict,
    read_gap,
)
from pipeline.json_files import json_text
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain, EffectTerm, chain_scales, input_steps
from pipeline.plant.simulator.laws import shaped_input
from pipeline.report.document import Formula
from pipeline.report.equations.effects import augmented_equations, in_order, law
from pipeline.report.figures.gap import predicted_figure
from pipeline.report.gap.gap_report import LEGEND, build_gap_document, make_gap_files
from pipeline.report.gap.load_gap import with_gap
from pipeline.report.gap.verdict import WORDS, kept_together, terminal_verdict
from pipeline.report.lab_report.content import build_document
from pipeline.report.render.folder import write_files
from pipeline.report.render.html import render_html
from pipeline.results import Provenance
from pipeline.setup import Setup
from pipeline.submission import load_submission
from pipeline.words.math import to_text
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.effects import make_term
from tests.report.test_report import HOSTILE, Page
from tests.truth.cases import make_case

CHAIN = PRESETS["throne-2dof"]
T = np.arange(0.0, 4.0, 0.00884)
U = np.where((T > 0.1) & (T < 2.0), 0.05, 0.0)


# -------------------------------------------------------------- constructed gaps


def usual_values(effect, place):
    """Return parameter values of usual size."""
    scales = chain_scales(CHAIN, place=effect.place, at=place, input=0.05)
    return {p.name: p.size(scales) * p.typical for p in effect.parameters}


RESIDUAL = Residual(
    cart=2,
    unit="V",
    against=(
        ForceAgainst(
            quantity="velocity", unit="cm/s", at=(-1.0, 2.0), force=(0.1, -0.4),
            spread=(0.02, None), formula=(0.1, -0.4),
        ),
    ),
    formula=ForceFormula(
        terms=(
            FormulaTerm(term="v|v|", coefficient=-0.1, std=0.01, unit="V s^2/cm^2"),
            FormulaTerm(term="|u| sign v", coefficient=0.02, std=0.001, unit="1"),
        ),
        explains=0.9,
    ),
)  # fmt: skip


def make_gap(verdict: Verdict = "named", keys=("coulomb_friction",)) -> Gap:
    """Return a plausible gap of the two-cart bench, with traces of the first cart's runs."""
    terms: list[EffectTerm] = []
    for key in keys:
        effect = find_effect(key)
        place = effect.places((True, True, True))[-1]
        terms.append(
            make_term(effect, place=place, values=usual_values(effect, place), chain=CHAIN)
        )
    linear, model = AugmentedChain(chain=CHAIN), AugmentedChain(chain=CHAIN, terms=tuple(terms))
    rng = np.random.default_rng(7)
    before, after = (simulate_augmented(m, T, U) for m in (linear, model))
    traces = [
        Trace(
            experiment=run, cart=cart, held_out=held, t=T, u=U, baseline=before[cart - 1],
            measured=after[cart - 1] + rng.normal(0.0, 0.001, T.size), final=after[cart - 1],
        )
        for run, held in (("step-a", True), ("step-b", False))
        for cart in (1, 2)
    ]  # fmt: skip
    errors = np.linspace(0.153, 0.041, len(terms) + 1)
    rivals = (
        Alternative(
            effect=find_effect("quadratic_drag"), where={"cart": 2}, nrmse_after=0.042,
            confidence=0.4,
        ),
        Alternative(
            effect=find_effect("stiction"), where={"cart": 2}, nrmse_after=0.3, confidence=0.001
        ),
    )  # fmt: skip
    effects = tuple(
        FoundEffect(
            effect=term.effect,
            where=term.where,
            parameters={
                p.name: NamedValue(
                    value=value, std=0.02 * abs(value),
                    unit=p.unit_text(position="cm", input="V"),
                )
                for p, value in zip(term.effect.parameters, term.values, strict=True)
                if p.reported
            },
            details={},
            confidence=0.6,
            nrmse_before=float(errors[i]),
            nrmse_after=float(errors[i + 1]),
            rivals=rivals if i + 1 == len(terms) else (),
        )
        for i, term in enumerate(terms)
    )  # fmt: skip
    return Gap(
        title="Two carts",
        bench=Setup(springs=(True, True, True)),
        provenance=Provenance(files={"data/step-a.csv": "0" * 64}),
        verdict=verdict,
        effects=effects,
        baseline=0.153,
        final=float(errors[-1]),
        noise_floor=0.03,
        repeatability=None,
        free_run=tuple(
            FreeRun(experiment=run, error=error)
            for run, error in (("step-a", 0.1), ("step-b", None))
        ),
        residual=(RESIDUAL,) if verdict in ("partial", "unexplained") else (),
        by_record=tuple(
            RecordGap(
                experiment=t.experiment, cart=t.cart, held_out=t.held_out, baseline=0.153,
                final=0.041, noise_floor=0.03,
            )
            for t in traces
        ),
        where=(
            GapWindow(
                experiment="step-b", cart=2, start=2.0, end=2.6, what="velocity near zero",
                share=0.62,
            ),
        ),
        left=()
        if verdict in ("none", "named")
        else (
            GapWindow(
                experiment="step-b", cart=2, start=2.0, end=2.6, what="velocity near zero",
                share=0.31,
            ),
        ),
        next_experiment="" if verdict == "none" else "Steps of three sizes.",
        linear=linear,
        model=model,
        training=("step-b",),
        held_out=("step-a",),
        traces=tuple(traces),
        chain_std={f"{letter}_{i}": 1e-7 for letter in "mck" for i in (1, 2)},
        spread={2: 0.05} if "coulomb_friction" in keys else {},
        notes=("no run could be spared for testing, so the last 40 % of the longest is held out",),
    )  # fmt: skip


def two_cart_analysis():
    """Return an analysis whose recordings belong to the constructed gaps."""
    analysis = make_analysis(2)
    step = next(record for record in analysis.records if record.id == "step-a")
    return replace(analysis, records=(step, replace(step, id="step-b")))


def page_of(gap: Gap) -> Page:
    """Return the parsed page of a gap report."""
    return Page(render_html(build_gap_document(gap, two_cart_analysis())))


def test_the_first_paragraph_names_the_effect_with_its_numbers():
    """The first paragraph names the effect, its place, its size, the errors and the noise."""
    text = page_of(make_gap()).text

    assert "Dry (Coulomb) friction on cart 2 explains what the linear model leaves out" in text
    assert "falls from 15.3 % of the motion to 4.1 %; noise alone accounts for 3.0 %" in text
    assert text.index("explains what") < text.rindex("Where the linear model fails")


def test_each_force_is_given_with_its_cart():
    """If both carts have dry friction, each force is given with its cart.

    The sentence on dry friction appears only once.
    """
    gap = make_gap()
    (one,) = gap.effects
    said = terminal_verdict(replace(gap, effects=(replace(one, where={"cart": 1}), one)))

    assert re.search(r"force [^;]+ V on cart 1; force [^;]+ V on cart 2\. ", said)
    assert said.count(one.effect.sentence) == 1
    assert " V on cart" not in terminal_verdict(gap)  # the effect's name includes the cart


def test_an_evenly_spread_error_is_described():
    """If the error is spread evenly over a part of the run, the sentence and the table say so."""
    gap = replace(make_gap("partial"), noise_floor=0.01)
    (window,) = gap.left
    text = page_of(replace(gap, left=(replace(window, what="throughout"),))).text

    assert "(evenly over the whole stretch)" in text
    assert "throughout" not in text


def test_scattering_repeats_are_compared_with_the_models_error():
    """If repeats differ by more than the noise, the model's error is compared with the repeats."""
    gap = replace(make_gap(), repeatability=0.035)
    text = page_of(gap).text

    assert "to 4.1 %; repeats of one run differ by 3.5 %" in text


def test_suspects_are_listed_with_their_errors():
    """If the verdict is unexplained, each suspect is listed with the error that would remain."""
    suspect = Alternative(
        effect=find_effect("backlash"), where={}, nrmse_after=0.12, confidence=0.9
    )
    gap = replace(make_gap("unexplained", ()), final=0.153, suspects=(suspect,))
    text = page_of(gap).text

    assert "Suspected, though not proven: backlash between motor and cart 1" in text
    assert "cart 1 (leaves an error of 12.0 %)" in text
    assert read_gap(json_text(gap)).suspects == gap.suspects


def test_the_page_of_the_verdict_none_mentions_no_effects():
    """If the verdict is "none", the page mentions no effects and draws only one model."""
    gap = replace(make_gap("none", ()), final=0.031, baseline=0.031, where=())
    page = page_of(gap)

    for wrong in (
        "With 0 effects",
        "Where the linear model fails",
        "the residual of each model",
        "before (ring)",
        "An observer then followed",
    ):
        assert wrong not in page.text
    assert "No effect is needed" in page.text
    assert "with the effects" not in html_of(gap)  # nor do the legends of the figures
    assert tones(gap) == ["good", ""]
    assert "Error and noise of every run" in page.text
    assert "cart 1 up to" in page.text
    assert "the input up to 0.0500 V" in page.text
    # A search begins at a chi-square of 1.15 per point. With noise of 3 %: 3 % √(1.15 - 1) = 1.2 %.
    assert "by more than about 1.2 % of their motion" in page.text
    assert page.text.index("What to do next") < page.text.rindex("Error and noise of every run")
    assert "What to do next." in terminal_verdict(gap)


def test_an_unexplained_gap_is_drawn_without_effects():
    """If the verdict is unexplained, no figure shows a model with effects.

    If there are suspects, figures show the model with the suspects, marked as such.
    """
    alone = make_gap("unexplained", ())
    assert "with the effects" not in html_of(alone)
    assert "With 0 suspects" not in page_of(alone).text
    suspected = make_gap("unexplained")
    assert "With 1 suspect" in page_of(suspected).text
    assert "The model with the suspects" in page_of(suspected).text
    assert "with the effects" not in html_of(suspected)
    assert "with the suspects" in html_of(suspected)


def test_an_ambiguous_error_is_neither_good_nor_bad():
    """If the verdict is ambiguous, the remaining error is marked neither good nor bad."""
    assert tones(make_gap("ambiguous")) == ["", "", ""]
    assert (
        "One explanation: dry (Coulomb) friction on cart 2" in page_of(make_gap("ambiguous")).text
    )
    assert tones(make_gap("named")) == ["", "good", ""]
    assert tones(make_gap("partial")) == ["", "bad", ""]


def html_of(gap: Gap) -> str:
    """Return the page of a gap report, including the text in its figures."""
    return render_html(build_gap_document(gap, two_cart_analysis()))


def tones(gap: Gap) -> list[str]:
    """Return the marks of the tiles at the top, such as "good" or "bad"."""
    return re.findall(r'<div class="tile (\w*)"', html_of(gap))


def test_both_explanations_are_described():
    """If the verdict is ambiguous, both explanations and the deciding experiment are described."""
    text = page_of(make_gap("ambiguous")).text

    assert "Dry (Coulomb) friction on cart 2, or quadratic drag on cart 2" in text
    assert "these data cannot tell which" in text
    assert "The experiment that would tell them apart. Steps of three sizes." in text
    assert find_effect("quadratic_drag").deciding_run in text
    assert "explains what" not in text


@pytest.mark.parametrize("keys", [(), ("coulomb_friction",)])
def test_an_unexplained_gap_names_only_suspects(keys):
    """If the verdict is unexplained, suspects are named, but not as an explanation."""
    text = page_of(make_gap("unexplained", keys)).text

    assert "nothing in the catalogue explains" in text
    assert ("best suspect is dry (Coulomb) friction" in text) == bool(keys)
    assert "explains what" not in text


def test_a_partial_verdict_says_how_much_error_is_left():
    """If the verdict is partial, the page says how much error remains, and where."""
    gap = replace(make_gap("partial"), noise_floor=0.01)
    text = page_of(gap).text

    assert "explains part of what the linear model leaves out" in text
    assert "The error is still 4.1 times that" in text
    assert "step-b, cart 2, from 2.00 to 2.60 s (velocity near zero)" in text
    assert "Where the model with its effects fails most" in text
    assert "its largest part is in" not in terminal_verdict(make_gap())


@pytest.mark.parametrize("verdict", ["partial", "unexplained"])
def test_the_unexplained_force_has_a_figure_and_a_formula(verdict):
    """The unexplained force is drawn for each cart, with a formula that is not in the catalogue."""
    page = page_of(make_gap(verdict))

    assert "The unexplained force" in page.text
    assert "Not in the catalogue" in page.text
    assert "f = -0.1 v|v| + 0.02 |u| sign v" in page.text
    alts = [
        alt for alt in page.values("aria-label") if alt.startswith("Unexplained force on cart 2")
    ]
    assert len(alts) == 1

    assert "The unexplained force" not in page_of(make_gap()).text


def test_an_answer_at_the_time_limit_is_called_the_best_so_far():
    """If the time budget ended the search, the page calls its result the best answer so far."""
    text = page_of(replace(make_gap("unexplained", ()), complete=False)).text

    assert "best answer so far" in text
    assert "The same input gives the same report." not in text
    assert "best answer so far" not in page_of(make_gap()).text


def test_effects_that_help_only_together_are_one_step():
    """If an effect helps only together with the next one, the page treats both as one step.

    The table has one row for both. Each effect's section gives the error before and after both
    effects.
    """
    gap = make_gap("partial", ("coulomb_friction", "saturation", "dead_zone"))
    errors = (0.135, 0.0925, 0.0968, 0.0723)
    gap = replace(
        gap,
        effects=tuple(
            replace(found, nrmse_before=before, nrmse_after=after)
            for found, before, after in zip(gap.effects, errors, errors[1:], strict=False)
        ),
    )
    text = page_of(gap).text

    said = (
        "from 9.2 % of the motion to 7.2 %. With saturation of the input alone it would be 9.7 %."
    )
    assert text.count(said) == 2
    assert "with saturation of the input and dead zone of the input7.2 %" in text
    assert "with dry (Coulomb) friction on cart 29.2 %" in text
    assert "from 13.5 % of the motion to 9.2 %." in text
    assert "9.7 % of the motion" not in text
    friction, saturation, dead_zone = gap.effects
    assert kept_together(gap.effects) == [(friction,), (saturation, dead_zone)]


@pytest.mark.parametrize("seen", [True, False])
def test_the_band_of_the_noise_is_mentioned_if_it_can_be_seen(seen):
    """A caption mentions the noise band only if the residuals are not much larger than the noise.

    If `seen` is true, both models leave only noise; otherwise the linear model's error is large.
    """
    gap = make_gap()
    if seen:
        gap = replace(gap, traces=tuple(replace(one, baseline=one.final) for one in gap.traces))

    assert ("the band is twice the noise" in page_of(gap).text) == seen


LINE = np.linspace(0.0, 1.0, 50)
PREDICTION = Prediction(
    pair=(0, 1), cart=2, t=LINE, u=LINE, positions=np.array([np.sin(LINE), np.cos(LINE)])
)


def predicted(first, second) -> Gap:
    """Return a gap that proposes a recording to decide between two models with these effects."""
    contenders = tuple(
        AlternativeModel(chain=CHAIN, terms=make_gap("named", keys).model.terms, weight=0.5)
        for keys in (first, second)
    )
    proposal = Proposal(
        recording={"wave": "triangle", "amplitude": 0.6, "frequency": 0.12},
        limits={},
        separation=42.0,
        prediction=PREDICTION,
    )
    return replace(make_gap("partial"), contenders=contenders, proposal=proposal)


MANY = ("cogging", "drive_damping", "input_delay", "slack_spring", "coulomb_friction")


@pytest.mark.parametrize(
    ("first", "second", "names", "legend"),
    [
        (
            ("coulomb_friction",),
            ("cogging", "coulomb_friction"),
            "the model with cogging of the motor and the one without it",
            ["with cogging of the motor", "without it"],
        ),
        (
            ("end_stop", "coulomb_friction"),
            ("end_stop", "cubic_spring"),
            "the model with dry (Coulomb) friction on cart 2 and the one with ",
            ["the first model", "the second model"],
        ),
        (
            ("saturation",),
            ("saturation", *MANY),
            "and dry (Coulomb) friction on cart 2 and the one without them",
            ["with these effects", "without them"],
        ),
    ],
)
def test_two_models_are_named_by_their_differences(first, second, names, legend):
    """The text names the effects that only one model has, and the legend shows short names."""
    gap = predicted(first, second)
    page = page_of(gap)

    assert names in page.text
    shared = set(first) & set(second)
    deciding = page.text[page.text.index("Of all recordings") :].split("times the noise")[0]
    for key in shared:
        assert find_effect(key).title[1:] not in deciding
    for label in legend:
        assert f">{label}</text>" in html_of(gap)


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
    page = page_of(make_gap("named", (effect.key,)))

    assert effect.fingerprint in page.text
    assert effect.reference in page.text
    assert f"The evidence for {effect.title[:1].lower()}" in page.text
    assert "\\" not in page.text
    assert not re.search(r"\b(None|nan|inf)\b", page.text)
    alts = [alt for alt in page.values("aria-label") if alt.startswith("Evidence for")]
    alts = [alt for alt in alts if effect.fingerprint in alt]
    assert alts


@pytest.mark.parametrize(
    "keys", list(permutations(("saturation", "actuator_lag", "dead_zone", "input_delay")))[::5]
)
def test_changes_of_the_input_are_applied_as_in_the_simulator(keys):
    """The input's changes are applied in the simulator's order, however the effects are listed.

    The input after the last change pushes cart 1 and enters the load-dependent friction.
    """
    terms = make_gap("named", (*keys, "load_friction")).model.terms
    laws = [to_text(law(terms, index).math) for index in in_order(terms)]

    assert [text.replace(" ", "") for text in laws] == [
        "u_a=\u2009sign\u2009u·\u2009max(|u|−w,0)",
        "u_b=\u2009clip(u_a,−L,L)",
        "u_c(t)=u_b(t−T)",
        "τu′_d+u_d=u_c",
        laws[-1].replace(" ", ""),
    ]
    assert laws[-1].startswith("f_e = −μ|u_d|")
    first, second = to_text(augmented_equations((True, True, True), terms).math).split("; ")
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


def test_with_backlash_the_input_pushes_the_motor():
    """With backlash, cart 1 feels the contact; the motor feels input, contact and cogging.

    The motor's mass is part of m_1, so it is subtracted on the right-hand side.
    """
    terms = make_gap("named", ("backlash", "cogging", "input_delay", "drive_damping")).model.terms
    laws = [to_text(law(terms, index).math) for index in in_order(terms)]

    motion = to_text(augmented_equations((True, True, True), terms).math)
    assert motion.split("; ")[0].endswith("= f_a + m_mx″_1 + f_d")
    assert laws[0].endswith("m_mx″_m = u_c−f_a + f_b")
    assert "x_m/λ" in laws[1]


def test_a_model_of_many_effects_has_its_equations():
    """Each of a dozen effects has its own letter in the equations."""
    keys = ("saturation", "dead_zone", "input_delay", "actuator_lag", "cogging", "drive_damping",
            "coulomb_friction", "quadratic_drag", "cubic_spring", "slack_spring", "end_stop",
            "coupling_damper")  # fmt: skip
    terms = make_gap("named", keys).model.terms
    laws = [to_text(law(terms, index).math) for index in in_order(terms)]

    named = [re.search("[uf]′?_(.)", text) for text in laws]
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


def test_a_spring_pulls_both_of_its_carts():
    """The extra force of spring 2 acts on cart 2 and, reversed, on cart 1."""
    terms = (
        make_term(find_effect("cubic_spring"), place=2, values={"coefficient": 1.0}, chain=CHAIN),
    )
    motion = to_text(augmented_equations((True, True, True), terms).math)
    first, second = motion.split("; ")
    assert first.endswith("= u + f_a")
    assert second.endswith("= −f_a")
    assert to_text(law(terms, 0).math) == "f_a = ad^3"


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
    assert "explains what the linear model leaves out" in first
    assert "The experiment that would confirm it" in first


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


@pytest.mark.parametrize("verdict", ["named", "partial", "none", "ambiguous", "unexplained"])
def test_the_file_is_read_back_as_it_was(verdict):
    """A `gap.json` that is read and written again is the same, with the same verdict."""
    keys = () if verdict == "none" else ("end_stop", "input_delay")
    gap = make_gap(verdict, keys)
    text = json_text(gap)

    again = read_gap(text)

    assert json_text(again) == text
    assert again.provenance == gap.provenance
    assert again.bench == gap.bench
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
    folder = tmp_path_factory.mktemp("bench")
    (folder / "data").mkdir()
    case = make_case(seed=41, n=1, effects=["coulomb_friction"], rate=113.1)
    toml = (
        'version = 1\ntitle = "Bench 7"\n[system]\ncarts = 1\n'
        'position = { unit = "cm" }\ninput = { unit = "V", sign = 1 }\n'
    )
    for record in case.records:
        if record.id == "sweep":
            continue
        # The last step is stated to be a closed loop, since its input was measured.
        kind = "closed_loop" if record.id == "step-d" else record.kind
        reference = np.zeros(record.t.size)
        columns = [record.t, record.u, reference, record.y[0]]
        rows = [f"{t:.6f},{u:.6f},{r:.1f},{x:.5f}" for t, u, r, x in zip(*columns, strict=True)]
        name = f"data/{record.id}.csv"
        text = "\n".join(["time,input,reference,x1", *rows]) + "\n"
        (folder / name).write_text(text, encoding="utf-8")
        toml += f'[[experiments]]\nid = "{record.id}"\nkind = "{kind}"\nfile = "{name}"\n'
    (folder / "submission.toml").write_text(toml, encoding="utf-8")
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
    assert "Dry (Coulomb) friction on cart 1 explains" in bench.done.stderr
    assert "model.fmu, model.c, model.h and model.m" in bench.done.stderr
    force = effect["parameters"]["force"]["value"]
    for name in ("model.c", "model.m"):
        assert f"coulomb_friction_1_force = {force}" in (out / name).read_text(encoding="ascii")


@pytest.mark.slow
@pytest.mark.sample
def test_report_shows_the_verdict_and_the_better_simulation(bench):
    """The report quotes the gap analysis of its data and simulates with the effects found."""
    analysis, gap = with_gap(analyse(load_submission(bench.folder)), bench.folder)
    assert gap is not None
    assert analysis.warnings == analyse(load_submission(bench.folder)).warnings

    page = Page(render_html(build_document(analysis, gap=gap)))

    assert "What the linear model leaves out" in page.text
    assert "Dry (Coulomb) friction on cart 1 explains" in page.text
    linear, augmented = map(
        float, re.findall(r"step-d1(\d+(?:\.\d+)?) %(\d+(?:\.\d+)?) %", page.text)[-1]
    )
    # The fit did not use this run, so the error is only the encoder's rounding.
    assert augmented < 0.2 * linear
    assert {href[1:] for href in page.values("href") if href.startswith("#")} <= set(
        page.values("id")
    )


def test_gap_analysis_of_other_data_is_only_a_warning(bench, tmp_path):
    """If the data have changed since the gap analysis, the report warns and does not quote it."""
    analysis = analyse(load_submission(bench.folder))
    changed = replace(analysis, files=analysis.files | {"data/step-a.csv": "0" * 64})

    warned, gap = with_gap(changed, bench.folder)

    assert gap is None
    assert warned.warnings[-1].startswith("gap/gap.json belongs to other data than this report")
    assert with_gap(analysis, tmp_path) == (analysis, None)
    for text in ("{", "[" * 200_000, " " * 20_000_000):
        (tmp_path / "gap.json").write_text(text, encoding="utf-8")
        assert "gap.json cannot be used" in with_gap(analysis, tmp_path)[0].warnings[-1]


def test_hostile_text_in_a_gap_file_stays_text(bench):
    """Hostile text in a `gap.json` appears as plain text."""
    analysis = analyse(load_submission(bench.folder))
    text = (bench.folder / "gap" / "gap.json").read_text(encoding="utf-8")
    document = json.loads(text) | {"next_experiment": HOSTILE}
    gap = read_gap(json.dumps(document))

    page = Page(render_html(build_document(analysis, gap=gap)))

    assert not {tag for tag, _ in page.tags} & {"img", "iframe"}
    assert sum(tag == "script" for tag, _ in page.tags) == 1
    assert "<script>alert(1)</script>" in page.text


def test_a_folder_without_a_submission_gives_one_line(tmp_path):
    """If a folder is not a submission, `cartlab gap` ends with one line and status 2."""
    done = cartlab_here("gap", tmp_path / "nowhere")

    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_every_formula_has_a_text_alternative():
    """Every formula has a text alternative for readers who cannot see it."""
    document = build_gap_document(make_gap("named", ("extra_mode",)), two_cart_analysis())
    formulas = [b for s in document.sections for b in s.blocks if isinstance(b, Formula)]

    assert formulas
    assert all(formula.alt for formula in formulas)
