"""A search reports no crutches, no false hands, and no springs that do not exist."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.force_balance import find_interventions
from pipeline.gap.explain import explain_gap
from pipeline.gap.fit import evaluate, restart_runs
from pipeline.gap.judge import build_up, fit_free_run, judge
from pipeline.gap.pem.fit import start_all
from pipeline.gap.runs import make_run, split_holdout
from pipeline.gap.search import OutOfTime, are_followed, find_hypotheses, follow
from pipeline.gap.summary import repeatability
from pipeline.results import Record
from pipeline.setup import Setup
from tests.gap.begun import begun, with_effects
from tests.truth.bench import Hidden, simulate_truth
from tests.truth.cases import COUNT, make_case

DELAY = Hidden(effect="input_delay", parameters={"delay": 0.012})
LAG = Hidden(effect="actuator_lag", parameters={"time_constant": 0.03})


def from_first_edge(record: Record) -> Record:
    """Return a step that begins when its input is switched on."""
    assert record.u is not None
    first = int(np.argmax(record.u != 0.0)) if record.kind == "step" else 0
    return replace(record, t=record.t[first:], u=record.u[first:], y=record.y[:, first:])


# ---------------------------------------------------------- the input before the first sample


@pytest.mark.parametrize("hidden", [DELAY, LAG])
def test_steps_that_begin_with_their_input_show_delay_and_lag(hidden):
    """A step may begin at its first sample: the drive was at rest before."""
    case = make_case(seed=46, n=1, effects=[hidden], rate=250.0)
    records = [from_first_edge(record) for record in case.records]

    gap = explain_gap(records, Setup(springs=case.springs))

    assert (gap.verdict, [f.effect.key for f in gap.effects]) == ("named", [hidden.effect])
    ((name, true),) = hidden.parameters.items()
    found = gap.effects[0].parameters[name]
    assert found.std is not None
    # The truth's own steps are 0.2 ms long.
    assert found.value == pytest.approx(float(true), abs=4.0 * found.std + 2e-5)


def steady(y: float, u: list[float]) -> Record:
    """Return a record of a cart that rests at `y` and moves after half a second at the latest."""
    t = np.asarray(np.arange(200) * 0.01, dtype=np.float64)
    moved = np.where(t > 0.52, np.sin(8.0 * (t - 0.52)), 0.0)
    values = np.interp(t, [0.0, 0.5, 0.51, 2.0], u)
    return Record(
        id="run", kind="sweep", t=t, u=values, y=(y + moved)[None], carts=(1,), free=(1,),
        resolution=np.array([COUNT]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("y", "u", "before"),
    [
        (0.0, [0.0, 0.0, 1.0, 1.0], 0.0),
        (1.0, [2.0, 2.0, 0.0, 0.0], 2.0),  # rests in balance with its input
        (0.0, [2.0, 2.0, 0.0, 0.0], 2.0),  # held by friction, perhaps, but does not move
    ],
)
def test_the_input_before_a_rest_is_what_balances_the_cart(y, u, before):
    """Before the first sample the input is that of the rest."""
    assert make_run(steady(y, u), n=1).command[0] == before


def test_an_input_that_moves_the_cart_at_once_was_not_there_before():
    """A cart that starts to move with the first sample was not pushed before; its start is open."""
    record = steady(0.0, [2.0, 2.0, 2.0, 2.0])
    record = replace(record, y=(1.0 - np.cos(8.0 * record.t))[None])

    run = make_run(record, n=1)

    assert run.command[0] == 0.0
    assert run.knots[0] < run.t[0]
    assert not run.at_rest


@pytest.mark.parametrize(("late", "alike"), [(0, True), (1, True), (4, False)])
def test_repeats_may_be_logged_a_sample_late(late, alike):
    """Two equal motions are repeats without a difference, though one edge is logged late."""
    case = make_case(seed=46, n=1, rate=113.1)
    step = next(record for record in case.records if record.kind == "step")
    assert step.u is not None
    again = replace(step, id="again", u=np.concatenate([np.zeros(late), step.u])[: step.t.size])

    found = repeatability([make_run(step, n=1), make_run(again, n=1)])

    # Removing a sample's delay leaves half of (omega h)², 0.7 %; three more samples leave 20 %.
    assert found is not None
    assert found < 7e-3 if alike else found > 0.05


def test_a_part_of_a_record_keeps_the_earlier_input():
    """The later part of a record knows the input before its first sample."""
    case = make_case(seed=46, n=1, rate=113.1)
    run = make_run(next(r for r in case.records if r.kind == "sweep"), n=1)

    training, held_out = split_holdout([run], notes=[])

    assert training[0].t[0] == run.t[0]
    assert held_out[0].t[0] > run.t[0]
    np.testing.assert_array_equal(held_out[0].knots, run.knots)
    np.testing.assert_array_equal(held_out[0].input, run.input[-held_out[0].t.size :])


# ----------------------------------------------------------------- the linear model, from decays


def test_decays_of_single_carts_are_explained_by_a_linear_chain():
    """If each cart was released alone, nothing relates the masses, and no effect is missing."""
    m, c = np.array([5.3e-3, 1.33e-3]), np.array([1.87e-3, 2.9e-3])
    k = np.array([0.386, 0.337, 0.487])
    t = np.asarray(np.arange(2000) * 0.005, dtype=np.float64)
    rng, records = np.random.default_rng(3), []
    for cart in (1, 2):
        for trial in (1, 2):
            x0 = np.zeros(2)
            x0[cart - 1] = 2.0 + trial
            free = (cart,)
            y = simulate_truth(m=m, c=c, k=k, t=t, u=np.zeros(t.size), free=free, x0=x0)
            y = np.round((y + 0.3 * COUNT * rng.standard_normal(y.shape)) / COUNT) * COUNT
            name = f"decay-{cart}-{trial}"
            records.append(
                Record(
                    id=name, kind="decay", t=t, u=None, y=y, carts=(1, 2), free=free,
                    resolution=np.full(2, COUNT),
                )
            )  # fmt: skip

    gap = explain_gap(records, Setup(springs=(True, True, True)))

    assert gap.verdict == "none"
    assert gap.final == pytest.approx(gap.noise_floor, rel=0.1)
    chain = gap.model.chain
    assert gap.bench.springs == (True, True, True)  # a spring that nothing determines stays
    own = (chain.k[:-1] + chain.k[1:]) / chain.m
    np.testing.assert_allclose(own, (k[:-1] + k[1:]) / m, rtol=1e-3)


# ------------------------------------------------------------------------- hands, and springs


def test_a_large_lag_is_no_hand():
    """A lag is no hand, although the force balance of a linear chain fails in the same way."""
    slow = Hidden(effect="actuator_lag", parameters={"time_constant": 0.12})
    case = make_case(seed=9, n=1, effects=[slow], rate=200.0)
    assert find_interventions(case.records)

    gap = explain_gap(case.records, Setup(springs=case.springs))

    assert gap.interventions == ()
    assert (gap.verdict, [f.effect.key for f in gap.effects]) == ("named", ["actuator_lag"])


def test_a_stated_spring_that_does_not_exist_is_left_out():
    """A spring that the recordings do not show is no effect; a note says that it is missing."""
    case = make_case(seed=4, n=2, rate=200.0)
    assert case.springs == (False, True, True)

    gap = explain_gap(case.records, Setup(springs=(True, True, True)))

    assert gap.verdict == "none"
    assert gap.bench.springs == case.springs
    assert any("wall-1" in note for note in gap.notes)


def test_only_a_motion_that_the_laws_give_is_followed():
    """A run is followed, a run with a hand in it is not, and nothing is if the model diverges."""
    fit, study = begun(rate=113.1)
    largest, own, *rest = study.training
    others = [largest, *rest]
    records = follow(others, study.catalogue, map)
    chains = [fit.structure.chain(fit.theta)]
    model = start_all(records, springs=study.springs, chains=chains)
    push = np.where((own.t > 1.0) & (own.t < 1.3), 0.3 * np.sin(10.0 * np.pi * (own.t - 1.0)), 0.0)
    touched = replace(own, y=own.y + push)
    unstable = replace(model, p=np.where(np.arange(model.p.size) == 1, -10.0, model.p))

    assert are_followed([(own, 0.9, 1.4), (touched, 0.9, 1.4)], model, records) == [True, False]
    assert are_followed([(own, 0.9, 1.4)], unstable, records) == [False]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("calls", [0, 3, 6, 12, 1000])
def test_an_answer_in_hand_is_kept_when_the_time_is_up(calls):
    """If the time is up while effects are confirmed, the model with all effects is the answer."""
    fit, study = begun(LAG, rate=113.1)
    done = 0

    def until(work, *items):
        nonlocal done
        done += 1
        if done > calls:
            raise OutOfTime
        return map(work, *items)

    hurried = replace(study, fitting=replace(study.fitting, mapper=until))
    chosen, found = find_hypotheses(judge(fit, study), hurried)

    assert chosen in found
    assert bool(chosen.key) == any(len(h.key) > 0 for h in found)
    assert calls < 1000 or chosen.key == {("actuator_lag", 0)}


# ------------------------------------------------------------- the smallest model, to its end


def test_a_law_alone_takes_the_place_of_its_crutches():
    """Laws that only imitate a part of another one are not in the model built from below."""
    fit, study = begun(LAG, rate=200.0)
    baseline, chain = judge(fit, study), fit.structure.chain(fit.theta)
    stiff = float(chain.k.sum())
    crutches = [
        (("actuator_lag", 0), (0.0295,)),
        (("input_delay", 0), (0.0005,)),
        (("extra_mode", 1), (0.1 * float(chain.m[0]), 3.0 * stiff, 0.1 * float(chain.c[0]))),
    ]
    model = with_effects(fit.without_nuisance, study, *crutches)
    full = judge(fit_free_run(model, study), study)
    assert len(full.key) == 3

    chosen = build_up(full, baseline, study)[-1]

    assert chosen.key == {("actuator_lag", 0)}
    assert study.is_noise(chosen)
    (true,) = LAG.parameters.values()
    assert chosen.fit.terms[0].values[0] == pytest.approx(float(true), rel=2e-3)


def test_a_single_held_out_run_is_restarted_at_another_rest():
    """With cogging a cart may rest in several places; a run at the wrong one is restarted."""
    values = {"force": 0.002, "pitch": 0.3, "phase": 0.5}
    fit, study = begun(Hidden(effect="cogging", parameters=values), rate=200.0)
    cogging = ("cogging", 0), tuple(values.values())
    model = with_effects(fit.without_nuisance, study, cogging)
    found = judge(fit_free_run(model, study), study)
    at, step = next((i, run) for i, run in enumerate(study.held_out) if run.at_rest)
    own = found.held.nuisance[at]
    moved = replace(own, zero=own.zero + 0.3, x0=own.x0 - [[0.3, 0.0]])
    wrong = evaluate(found.fit, [step], [moved], spread=found.fit.spread)
    assert wrong.chi > 100.0

    again = restart_runs(wrong, [step], map, usual=found.fit.chi)

    assert again.chi < 1.2
