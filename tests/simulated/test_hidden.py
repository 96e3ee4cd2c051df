"""Effects hidden in a synthetic bench.

They are tested in every kind of run, against limits and against an independent simulator.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.errors import ConfigError, DataError
from pipeline.ingest.read import read_data
from pipeline.json_files import plain
from pipeline.plant.augmented import rest_positions
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.sampled_loop import StateFeedback
from pipeline.simulated.bench import COUNT, SAMPLE_TIME, BenchRun, ReleasingHand, SimulatedBench
from pipeline.simulated.hidden import prepare_bench, preset_bench, usual_term
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.gaps import make_gap
from tests.truth.bench import Hidden, simulate_truth

TWO = PRESETS["throne-2dof"]
KEYS = [effect.key for effect in CATALOGUE]
# The independent simulator has its own law for these contacts.
OWN_CONTACT = {"backlash", "end_stop"}


def bench(*terms, chain=TWO):
    return SimulatedBench(chain=chain, effects=terms, noise_counts=0.0, zero_error_counts=0.0)


def usual(key, chain=TWO, **changes):
    """Return the effect at its usual place and size, with some parameters changed."""
    term = usual_term(find_effect(key), chain)
    values = term.parameters | changes
    return replace(term, values=tuple(values[name] for name in term.effect.names))


def clock(seconds):
    return SAMPLE_TIME * np.arange(round(seconds / SAMPLE_TIME), dtype=np.float64)


def step(n=2, seconds=3.0):
    t = clock(seconds)
    u = np.where((t > 0.3) & (t < 0.5 * seconds), -0.05, 0.0)
    return BenchRun(id="step", kind="step", t=t, u=u, free=tuple(range(1, n + 1)))


def decay(cart=1):
    t = clock(2.5)
    # The hand's tremor is at a turning point at the release, so the cart starts at rest.
    tremor = tuple(np.pi / 2 - 2 * np.pi * np.array([1.3, 4.1, 8.7]) * t[45])
    hand = ReleasingHand(cart=cart, position=-1.5, release=float(t[45]), fade=0.021, tremor=tremor)
    return BenchRun(id="decay", kind="decay", t=t, u=np.zeros(t.size), free=(cart,), hand=hand)


def control():
    t = clock(2.0)
    controller = StateFeedback(
        gains=np.array([0.02, 0.002, 0.01, 0.001]), prefilter=0.06, model=TWO
    )
    return BenchRun(
        id="control",
        kind="closed_loop",
        t=t,
        u=np.zeros(t.size),
        free=(1, 2),
        cart=2,
        reference=np.where(t > 0.2, 1.0, 0.0),
        controller=controller,
        input_limit=0.2,
    )


# -------------------------------------------------------------- whole submissions


def _cases():
    """Yield every effect on every preset; in the quick suite, each effect on one preset."""
    for i, key in enumerate(KEYS):
        for j, preset in enumerate(PRESETS):
            quick = i == 6 * j
            marks = () if quick else (pytest.mark.slow,)
            yield pytest.param(key, preset, marks=marks)


@pytest.fixture(scope="module")
def linear(tmp_path_factory):
    """Return a session without effects for each preset."""
    root = tmp_path_factory.mktemp("linear")
    for preset in PRESETS:
        write_submission(root / preset, preset, seed=3, compact=True)
    return root


@pytest.mark.parametrize(("key", "preset"), list(_cases()))
def test_an_effect_hides_in_a_whole_submission(tmp_path, linear, key, preset):
    """A hidden effect clearly changes a session's recordings, but no file names it."""
    chain = PRESETS[preset]

    write_submission(
        tmp_path, replace(preset_bench(preset), effects=(usual(key, chain),)), seed=3, compact=True
    )

    records = read_data(load_submission(tmp_path)).records
    others = read_data(load_submission(linear / preset)).records
    apart = [float(np.abs(a.y - b.y).max()) for a, b in zip(records, others, strict=True)]
    # Two readings of one position differ by at most a count and the encoder noise.
    assert max(apart) > 4 * COUNT
    assert key not in (tmp_path / "submission.toml").read_text(encoding="utf-8")
    assert {path.name for path in tmp_path.iterdir()} == {"submission.toml", "data"}


def test_several_effects_at_once():
    """Several effects can be hidden at once, at given places or at their usual ones."""
    hide = ["coulomb_friction:cart=2", "cubic_spring:spring=3,coefficient=0.02", "dead_zone"]
    prepared = prepare_bench(preset="throne-2dof", hide=hide)
    assert [(t.effect.key, t.place) for t in prepared.effects] == [
        ("coulomb_friction", 2),
        ("cubic_spring", 3),
        ("dead_zone", 0),
    ]


# ------------------------------------------------------------ against the truth


# The effects that change a closed loop in a different way each.
IN_LOOPS = {
    "coulomb_friction", "presliding_friction", "load_friction", "cubic_spring", "dead_zone",
    "input_delay", "actuator_lag", "extra_mode", "sensor_gain",
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "run"),
    [
        *((key, step()) for key in KEYS if key not in OWN_CONTACT),
        *((key, control()) for key in KEYS if key in IN_LOOPS),
    ],
    ids=lambda one: one if isinstance(one, str) else one.id,
)
def test_runs_agree_with_the_independent_simulator(key, run):
    """The 50-µs simulator, driven by the logged input, gives the logged motion in each run."""
    term = usual(key)
    hidden = Hidden(effect=key, place=term.place, parameters=term.parameters)

    moved, linear = bench(term).move(run), bench().move(run)

    opened = run.kind == "step"
    rest = rest_positions(AugmentedChain(chain=TWO, terms=(term,)))
    truth = simulate_truth(
        m=TWO.m, c=TWO.c, k=TWO.k, hidden=[hidden], t=run.t, u=moved.u, free=(1, 2),
        x0=rest if opened else None,
    )  # fmt: skip
    # The 50-µs simulator interpolates the input, so its phase errs by omega h / 2. That is 0.07
    # count in linear motion; in a loop the input has an edge at each sample.
    assert_allclose(moved.x, truth, atol=(0.2 if opened else 0.5) * COUNT)
    # The effect shows: in other motion, or in other inputs that the controller asks for.
    assert np.abs(moved.x - linear.x).max() > 2 * COUNT or not opened
    assert np.abs(moved.u - linear.u).max() > 1e-4 or opened


@pytest.mark.parametrize("key", ["coulomb_friction", "quadratic_drag", "cubic_spring"])
def test_releases_agree_with_the_independent_simulator(key):
    """From the release on, the 50-µs simulator moves the same way under the hand's force."""
    run, term = decay(), usual(key)
    hand = run.hand
    assert hand is not None

    x = bench(term).move(run).x

    start = int(np.searchsorted(run.t, hand.release))
    held = float(hand.hold(run.t[start])[0])
    spring = TWO.k[0] + TWO.k[1]
    extra = term.parameters["coefficient"] * held**3 if key == "cubic_spring" else 0.0
    fine = np.arange(run.t[start], run.t[-1] + 1e-9, SAMPLE_TIME / 40)
    # The force is linear between samples; each fine step takes its value in the middle.
    samples = run.t[start:]
    ramp = (spring * held + extra) * np.clip(1 - (samples - samples[0]) / hand.fade, 0, 1)
    push = np.interp(fine + SAMPLE_TIME / 80, samples, ramp)
    truth = simulate_truth(
        m=TWO.m, c=TWO.c, k=TWO.k, t=fine, u=push, free=(1,), x0=np.array([held, 0.0]),
        hidden=[Hidden(effect=key, place=term.place, parameters=term.parameters)],
    )  # fmt: skip
    # The phase of the 50-µs simulator errs by omega h / 2. At the spring's stiffest that is 1e-3 of
    # 1.5 cm.
    assert_allclose(x[0, start:], np.interp(samples, fine, truth[0]), atol=0.6 * COUNT)


# ------------------------------------------------------------------ what is special


def test_a_constant_force_shows_where_the_carts_rest():
    """Under a constant force the carts rest where the springs balance it.

    They rest elsewhere if other carts are held. Before a closed loop the encoders are zeroed at
    rest.
    """
    term = usual("force_offset")
    (force,) = term.values
    model = AugmentedChain(chain=TWO, terms=(term,))

    both, alone = rest_positions(model), rest_positions(model, free=(1,))

    assert_allclose(both, np.linalg.solve(TWO.stiffness, [force, 0.0]), rtol=1e-6)
    assert_allclose(alone, [force / TWO.stiffness[0, 0], 0.0], rtol=1e-6)
    assert_allclose(bench(term).move(step()).x[:, 0], both)
    # Before a closed loop the encoders are zeroed at rest.
    assert_allclose(bench(term).move(control()).x[:, 0], 0.0, atol=1e-12)


def test_a_sensor_deceives_the_controller():
    """If a sensor's gain is wrong, the loop brings its reading, not the cart, to the target."""
    run = control()
    gain = 1.1

    moved = bench(replace(usual("sensor_gain"), place=2, values=(gain,))).move(run)

    true = simulate_truth(m=TWO.m, c=TWO.c, k=TWO.k, t=run.t, u=moved.u, free=(1, 2))
    assert_allclose(moved.x[1], gain * true[1], atol=0.2 * COUNT)


@pytest.mark.parametrize(("stop", "rest"), [(-1.0, -0.9), (1.0, -1.5)])
def test_a_hand_stops_before_the_end_stop(stop, rest):
    """A hand pulls a cart as far as planned, but never into an end stop."""
    x = bench(usual("end_stop", position=stop)).move(decay()).x
    assert x[0, 0] == pytest.approx(rest, rel=0.01)


def test_carts_that_run_away_are_refused():
    """A spring that softens until carts run away gives one clear error, in any run."""
    soft = usual("cubic_spring", coefficient=-20.0)
    for run in (step(), control(), decay()):
        with pytest.raises(DataError, match="the carts diverge"):
            bench(soft).move(run)


def test_a_loop_cannot_look_ahead():
    """A drive that leads its log by more than a sample is refused in a loop."""
    assert np.all(np.isfinite(bench(usual("input_delay", delay=-SAMPLE_TIME)).move(control()).x))
    with pytest.raises(DataError, match="lead its log"):
        bench(usual("input_delay", delay=-0.02)).move(control())


# --------------------------------------------------------------- a stored model


def stored(prepared):
    """Return the `gap.json` of a bench, as the gap workflow writes it."""
    model = AugmentedChain(chain=prepared.chain, terms=prepared.effects)
    return plain(replace(make_gap(), model=model))


@pytest.mark.slow
@pytest.mark.sample
def test_a_stored_model_gives_the_same_records(tmp_path):
    """Simulating from `gap.json` gives exactly the records of the bench that it describes."""
    prepared = prepare_bench(preset="throne-1dof", hide=["stiction", "backlash:gap=0.02"])
    file = tmp_path / "gap.json"
    file.write_text(json.dumps(stored(prepared)), encoding="utf-8")

    again = prepare_bench(model=file)
    write_submission(tmp_path / "a", prepared, seed=5)
    write_submission(tmp_path / "b", again, seed=5)

    assert again.effect_sentences == tuple(
        text.replace(" (default)", "") for text in prepared.effect_sentences
    )
    for path in sorted((tmp_path / "a" / "data").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / "data" / path.name).read_bytes()


def test_a_model_in_counts_moves_as_far(tmp_path):
    """A model stored in counts moves the carts as far as the same model in centimetres."""
    chain = PRESETS["throne-1dof"]
    document = {
        "chain": {name: (getattr(chain, name) * COUNT).tolist() for name in "mck"},
        "units": {"position": "count", "input": "V"},
    }
    file = tmp_path / "gap.json"
    file.write_text(json.dumps(document), encoding="utf-8")

    prepared = prepare_bench(model=file)
    write_submission(tmp_path / "out", prepared, seed=1)

    records = read_data(load_submission(tmp_path / "out")).records
    (sweep,) = [record for record in records if record.kind == "sweep"]
    assert_array_equal(sweep.y, np.round(sweep.y))
    assert 300 < np.abs(sweep.y).max() < 700


def with_backlash(**sizes):
    """Return a model with a backlash of these sizes."""
    entry = {"effect": "backlash", "parameters": {"gap": 0.05, **sizes}}
    return {"chain": {"m": [2e-4], "c": [5e-4], "k": [0.035, 0.0]}, "effects": [entry]}


@pytest.mark.parametrize("command", ["simulate", "emulate"])
@pytest.mark.parametrize("sizes", [{"contact_stiffness": 1e30}, {"motor_mass": 1e-30}])
def test_a_model_too_stiff_to_simulate_is_one_line(command, sizes, tmp_path):
    """A model that would take too long to simulate is refused at once, with one line."""
    file = tmp_path / "gap.json"
    file.write_text(json.dumps(with_backlash(**sizes)), encoding="utf-8")
    out = ["--out", str(tmp_path / "out")] if command == "simulate" else []
    done = cartlab_here(command, "--model", str(file), *out)
    assert done.returncode == 2
    assert "stiffness is too" in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ("{", r"not valid JSON from line 1, character 2: give a complete gap.json"),
        ("[" * 100_000, "not the JSON"),
        ("[]", "no JSON object"),
        ({"effects": []}, "chain: missing"),
        ({"chain": {"m": [1.0], "c": [0.1]}}, "chain: needs 'k'"),
        ({"chain": {"m": [1.0], "c": [0.1], "k": [1.0]}}, "k: expected shape"),
        ({"chain": {"m": [-1.0], "c": [0.1], "k": [1.0, 0.0]}}, "m must be positive"),
        ({"chain": {"m": [1e-320], "c": [0.1], "k": [1.0, 0.0]}}, "expected sizes of 1e-30 to"),
        ({"chain": {"m": [1e-29], "c": [0.1], "k": [1.0, 0.0]}}, "rad/s, as on a bench"),
        ({"chain": {"m": [1.0, 1.0], "c": [0.1, 0.1], "k": [1.7e308, 1.7e308, 1.0]}}, "1.7e[+]308"),
        (with_backlash(gap=1e-320), "gap: expected 0 or a size of 1e-30 to .*, found 9.*e-321"),
        (with_backlash(motor_mass=0.0), "motor_mass must be positive, found 0"),
        (with_backlash(gap=-1.0), "gap must be positive, found -1"),
        ({"chain": {"m": [1.0], "c": [0.1], "k": [1.0, 0.0]}, "effects": [{"effect": "glue"}]},
         r"effects\[1\]: no effect 'glue'"),
    ],
)  # fmt: skip
def test_a_broken_model_is_one_line(tmp_path, document, message):
    """A mistake in the model's file gives one line that names the file and the place."""
    file = tmp_path / "gap.json"
    text = document if isinstance(document, str) else json.dumps(document)
    file.write_text(text, encoding="utf-8")

    with pytest.raises(ConfigError, match=message) as error:
        prepare_bench(model=file)

    assert "gap.json" in str(error.value)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- the option --hide


@pytest.mark.parametrize(
    ("hide", "message"),
    [
        ("coulomb", "no effect 'coulomb'; did you mean 'coulomb_friction'"),
        ("coulomb_friction:forse=1", "has no 'forse'; did you mean 'force'"),
        ("coulomb_friction:force", "write force=VALUE"),
        ("coulomb_friction:force=big", "force needs a number, found 'big'"),
        ("coulomb_friction:force=nan", "force needs a number, found 'nan'"),
        ("coulomb_friction:force=-1", "force must be at least 0"),
        ("coulomb_friction:force=1,force=2", "force is given twice"),
        ("coulomb_friction:cart=3", "no cart 3 on this bench; there is cart 1, 2"),
        ("coulomb_friction:cart=1.5", "no cart 1.5"),
        ("cubic_spring:spring=1", "no spring 1 on this bench; there is spring 2, 3"),
        ("dead_zone:cart=1", "dead_zone has no 'cart'"),
        ("saturation:limit=0", "limit must be positive"),
        ("stiction:force=0.02,static_force=0.01", "below the sliding force"),
    ],
)
def test_a_wrong_effect_is_one_line(hide, message):
    """A wrong name, place or size of an effect gives one line with the nearest valid one."""
    with pytest.raises(ConfigError, match=message):
        prepare_bench(preset="throne-2dof", hide=[hide])


def test_one_place_can_have_only_one_dry_friction():
    """Two laws of dry friction cannot be hidden at one place, but at two places they can."""
    with pytest.raises(ConfigError, match=r"cart 1 .*coulomb_friction"):
        prepare_bench(preset="throne-2dof", hide=["coulomb_friction", "stiction"])
    hide = ["coulomb_friction", "stiction:cart=2"]
    assert len(prepare_bench(preset="throne-2dof", hide=hide).effects) == 2


@pytest.mark.parametrize(
    ("unit", "centimetre"),
    [("cm", 1.0), ("mm", 10.0), ("m", 0.01), ("in", 1 / 2.54), ("count", 1 / 0.00227)],
)
def test_a_bench_from_a_file_travels_a_centimetre(unit, centimetre, tmp_path):
    """A bench that `prepare_bench` reads has the travel and counts of the lab, in its unit."""
    chain = {"m": [2e-4], "c": [5e-4], "k": [0.03, 0.0]}
    model = {"chain": chain, "units": {"position": unit, "input": "V"}}
    (tmp_path / "gap.json").write_text(json.dumps(model))
    bench = prepare_bench(model=tmp_path / "gap.json")
    assert bench.travel == pytest.approx(centimetre)
    assert bench.count == pytest.approx(0.00227 * centimetre)
