"""Effects hidden by an independent simulator are named with their place and size."""

import pytest

from pipeline.gap.explain import investigate
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.gap.test_explain import explain, names
from tests.truth.bench import Hidden
from tests.truth.cases import make_case, make_rig

LONG = [pytest.mark.slow, pytest.mark.sample]


@pytest.mark.parametrize(
    ("effect", "n"),
    [
        pytest.param("coulomb_friction", 2, marks=LONG),
        pytest.param("presliding_friction", 1, marks=LONG),
        pytest.param("cubic_spring", 2, marks=LONG),
        pytest.param("slack_spring", 1, marks=LONG),
        pytest.param("drive_damping", 1, marks=LONG),
        pytest.param("dead_zone", 1, marks=LONG),
        ("input_delay", 1),
        pytest.param("extra_mode", 1, marks=LONG),
        pytest.param("end_stop", 1, marks=LONG),
        pytest.param("force_offset", 2, marks=LONG),
        pytest.param("cogging", 1, marks=LONG),
    ],
)
def test_a_hidden_effect_is_named(effect, n):
    """A single hidden effect is named with place and size, and only noise remains."""
    case = make_case(seed=41, n=n, effects=[effect], rate=113.1)
    (hidden,) = case.hidden

    gap = explain(case)

    assert gap.verdict == "named"
    assert names(gap) == [(hidden.effect, hidden.place)]
    assert gap.baseline > 4.0 * gap.noise_floor
    # The limit is 1.2 times the noise floor, or three times for an end stop.
    assert gap.final < (3.0 if effect == "end_stop" else 1.2) * gap.noise_floor
    assert gap.spread == {}  # because friction is the same in every run of this bench
    for name, true in hidden.parameters.items():
        found = gap.effects[0].parameters[name]
        # The two simulators differ in the law of contact, and so in the contact's stiffness.
        limit = 0.2 if effect == "end_stop" and name == "stiffness" else 0.02
        assert found.value == pytest.approx(true, rel=limit, abs=5 * (found.std or 0.0))


@pytest.mark.slow
@pytest.mark.sample
def test_a_hidden_mass_that_moves_at_the_release_is_found(tmp_path):
    """A hidden mass is found even if it is already moving when a hand releases the cart."""
    bench = prepare_bench(preset="throne-2dof", model=None, hide=["extra_mode"])
    write_submission(tmp_path / "bench", bench, seed=3, reported=False)

    gap = investigate(analyse(load_submission(tmp_path / "bench")), progress=lambda text: None)

    assert names(gap) == [("extra_mode", 1)]
    assert gap.final < 1.2 * gap.noise_floor


@pytest.mark.slow
@pytest.mark.sample
def test_two_effects_are_found_together():
    """Two hidden effects are both named."""
    case = make_case(seed=44, n=1, effects=["coulomb_friction", "saturation"], rate=113.1)

    gap = explain(case)

    assert names(gap) == [("coulomb_friction", 1), ("saturation", 0)]
    assert gap.effects[-1].nrmse_after == gap.final


@pytest.mark.parametrize(
    ("effect", "hardness", "part"),
    [
        pytest.param("end_stop", 25.0, 0.6, marks=pytest.mark.slow),
        pytest.param("slack_spring", 3.0, 0.6, marks=LONG),
        pytest.param("end_stop", 5.0, 0.9, marks=LONG),
        pytest.param("end_stop", 5.0, 0.6, marks=pytest.mark.slow),
        pytest.param("slack_spring", 0.5, 0.9, marks=LONG),
        pytest.param("slack_spring", 8.0, 0.6, marks=pytest.mark.slow),
    ],
)
def test_a_stop_and_a_stiffening_spring_are_distinguished(effect, hardness, part):
    """Neither an end stop nor a stiffening spring is taken for the other, wherever it begins.

    An end stop may be soft and lossless. If a stiffening spring fits equally well, both are listed.
    """
    bare = make_case(seed=7, n=1, rate=200.0)
    top = part * max(float(r.y.max()) for r in bare.records if r.kind == "step")
    k = sum(bare.k)
    sizes = {
        "end_stop": {"position": top, "stiffness": hardness * k},
        "slack_spring": {"stretch": top, "stiffness_change": hardness * k / bare.k[0]},
    }
    hidden = Hidden(effect=effect, place=1, parameters=sizes[effect])

    gap = explain(make_case(seed=7, n=1, effects=[hidden], rate=200.0))

    assert gap.verdict in ("named", "ambiguous")
    assert names(gap) == [(effect, 1)]
    assert gap.final < 1.2 * gap.noise_floor


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("n", [2, 3])
def test_friction_on_all_carts_is_found_at_once(n):
    """On a realistic rig, friction on all carts is found in one step, with a force for each cart.

    The rig also has damping while the motor drives, and carts released by hand. The remaining error
    is only noise.
    """
    case = make_rig(seed=1, n=n)

    told: list[str] = []
    gap = explain(case, progress=told.append)

    assert gap.verdict == "named"
    assert names(gap) == sorted((h.effect, h.place) for h in case.hidden)
    assert gap.final < 1.2 * gap.noise_floor
    for hidden in case.hidden:
        (found,) = (
            f
            for f in gap.effects
            if (f.effect.key, f.where.get("cart", 0)) == (hidden.effect, hidden.place)
        )
        for name, true in hidden.parameters.items():
            # The force of each run scatters by 8 %, so the common force is known to 3 or 4 %.
            assert found.parameters[name].value == pytest.approx(float(true), rel=0.1)
