"""The plan that is proposed for a session at the bench, and its file."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError, DataError
from pipeline.experiments.plan import (
    PidLoop,
    Plan,
    PlanLimits,
    Recording,
    StateLoop,
    load_plan,
    plan_path,
    plan_text,
    save_plan,
)
from pipeline.experiments.propose import (
    AIM,
    add_recording,
    extend_plan,
    make_plan,
    propose_plan,
    release_by_hand,
)
from pipeline.plant.chain import PRESETS, quadratic_factors
from pipeline.plant.simulate import SETTLED_DWELL, settling_wait, simulate_linear
from pipeline.protocol import FULL_SCALE, Description, Start, Wave, target_at
from pipeline.submission import (
    Design,
    InputScale,
    PositionScale,
    Submission,
    System,
    load_submission,
    new_submission,
)
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import a_recorded_cart
from tests.helpers.examples import recorded

EXAMPLE_OF = {"throne-1dof": "one-cart", "throne-2dof": "two-cart", "throne-3dof": "three-cart"}
STOCK = Description(name="stock", encoders=2, carts=2)
FIRST = ("decay", "step", "sweep")


def bare(*, carts=2, springs=None, design=None, **system) -> Submission:
    """Return a submission without any recordings."""
    springs = (True,) * (carts + 1) if springs is None else springs
    system = System(
        carts=carts, springs=springs, **{"position": PositionScale(unit="cm"), **system}
    )
    return Submission(version=1, system=system, design=design)


def of_kind(plan: Plan, kind: str) -> list[Recording]:
    return [recording for recording in plan.recordings if recording.kind == kind]


# ------------------------------------------------------- before anything is known


def test_the_first_runs_suit_unknown_carts():
    """For unknown carts the plan has decays of each cart alone, small steps and one sweep."""
    plan = propose_plan(bare(carts=3))

    runs = [(r.kind, r.carts, r.release) for r in plan.recordings]
    assert runs[:6] == [("decay", (cart,), cart) for cart in (1, 1, 2, 2, 3, 3)]
    assert runs[6:] == [(kind, (1, 2, 3), None) for kind in ("step", "step", "sweep")]
    up, down = of_kind(plan, "step")
    assert up.amplitude == -down.amplitude > 0
    assert max(abs(r.amplitude) for r in plan.recordings) <= 0.05 * plan.limits.input


def test_carts_without_springs_get_no_release_and_no_step():
    """A cart without springs is not released, and carts tied to no wall get no step."""
    plan = propose_plan(bare(carts=1, springs=(False, False)))
    assert [r.kind for r in plan.recordings] == ["sweep"]
    plan = propose_plan(bare(carts=2, springs=(False, True, False)))
    assert [r.kind for r in plan.recordings] == ["decay"] * 4 + ["sweep"]


@pytest.mark.slow
@pytest.mark.sample
def test_a_stock_bench_gets_only_its_own_commands():
    """A stock bench gets only its own commands: a square wave as sweep, and its PID on cart 1."""
    (sweep,) = of_kind(propose_plan(bare(), bench=STOCK), "sweep")
    assert (sweep.wave, sweep.frequency_end) == ("square", None)
    whole = recorded("two-cart", *FIRST, "sine")
    with pytest.raises(DataError, match=r"system\.position\.per_count in cm"):
        extend_plan(propose_plan(whole, bench=STOCK), whole, bench=STOCK)
    position = whole.system.position.model_copy(update={"per_count": 0.00227})
    system = whole.system.model_copy(update={"position": position})
    whole = whole.model_copy(update={"system": system})
    (loop,) = extend_plan(propose_plan(whole, bench=STOCK), whole, bench=STOCK).recordings
    assert isinstance(loop.controller, PidLoop)
    assert loop.controller.cart == 1


@pytest.mark.parametrize(
    ("system", "design", "expected"),
    [
        ({}, None, (5.0, 2.5)),
        ({"input": InputScale(per_count=1e-4)}, None, (0.4096, 2.5)),
        ({"position": PositionScale(unit="mm")}, Design(input_limit=2.0), (2.0, 25.0)),
        ({}, Design(input_limit=9.0, reference=-4.0), (5.0, 5.0)),
        (
            {"position": PositionScale(unit="rad"), "input": InputScale(unit="N")},
            Design(reference=0.5, input_limit=7.0),
            (7.0, 1.2),
        ),
    ],
)
def test_limits_come_from_the_submission(system, design, expected):
    """Limits follow from the design, the input's scale and the units; otherwise defaults apply."""
    limits = propose_plan(bare(**system, design=design)).limits
    assert (limits.input, limits.travel) == expected


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_the_first_runs_move_the_carts_well_and_not_too_far(preset):
    """The first runs move the carts by more than 0.2 cm and stay within the travel limit."""
    chain, per_count = PRESETS[preset], 0.5 / FULL_SCALE
    plan = propose_plan(bare(carts=chain.n, input=InputScale(per_count=per_count)))
    for recording in (*of_kind(plan, "step"), *of_kind(plan, "sweep")):
        start = Start(
            wave=Wave[recording.wave.upper()],
            frequency=recording.frequency,
            amplitude=round(recording.amplitude / per_count),
            cycles=recording.cycles,
        )
        t = np.arange(0.0, recording.duration, 2e-3)
        targets = [target_at(start, at, chirp_end=recording.frequency_end) for at in t]
        x = np.abs(simulate_linear(chain, t, per_count * np.array(targets, dtype=np.float64)))
        assert 0.2 < x.max(axis=1).min(), recording.id
        assert x.max() < plan.limits.travel, recording.id


# --------------------------------------------------------- from what is recorded


@pytest.fixture(scope="module", params=sorted(PRESETS))
def extended(request):
    """Return a preset's chain, and the plan that follows from its decays, steps and sweep."""
    submission = recorded(EXAMPLE_OF[request.param], *FIRST)
    plan = propose_plan(submission)
    return PRESETS[request.param], extend_plan(plan, submission), submission


def test_dwells_bracket_every_resonance_and_null(extended):
    """Each resonance and null has a dwell very near it, and one on either side."""
    chain, plan, _ = extended
    dwells = np.array([2 * np.pi * r.frequency for r in of_kind(plan, "sine")])
    for roots in (chain.poles, *(chain.zeros(cart) for cart in range(1, chain.n))):
        for omega, zeta in zip(*quadratic_factors(roots), strict=True):
            away = dwells / omega - 1
            assert np.abs(away).min() < max(0.01, zeta)
            assert 0 < away[away > 0].min() < 0.15
            assert -0.15 < away[away < 0].max() < 0


def test_dwells_move_the_carts_well_within_the_limit(extended):
    """Dwells move the carts by 0.3 to 1.3 times the wanted distance, within the travel limit."""
    chain, plan, _ = extended
    aim = AIM * plan.limits.travel
    wait = settling_wait(chain, time_constants=SETTLED_DWELL)
    for run in of_kind(plan, "sine"):
        t = np.arange(0, run.duration, 1e-3 * max(1.0, 5 / run.frequency))
        u = run.amplitude * np.sin(2 * np.pi * run.frequency * t)
        x = np.abs(simulate_linear(chain, t, u))
        steady = x[:, t >= wait].max()
        assert 0.3 * aim < steady < 1.3 * aim, run.id
        assert x.max() < plan.limits.travel, run.id
        assert abs(run.amplitude) <= plan.limits.input
        # Enough of the dwell remains for six periods in steady state.
        assert (run.duration - wait) * run.frequency > 6


def test_steps_rest_near_the_aim_and_overshoot_within_the_limit(extended):
    """Steps end at 0.5 to 1 times the wanted distance, and overshoot within the limit."""
    chain, plan, _ = extended
    aim, amplitudes = AIM * plan.limits.travel, [r.amplitude for r in of_kind(plan, "step")]
    assert amplitudes[0] == -amplitudes[1]
    for run in of_kind(plan, "step"):
        t = np.arange(0, run.duration, 5e-3)
        on = (t * run.frequency) % 1 >= 0.5
        x = np.abs(simulate_linear(chain, t, np.where(on, run.amplitude, 0.0)))
        assert x.max() < plan.limits.travel
        assert 0.5 * aim < x[:, -1].max() < 1.05 * aim


def test_extending_twice_changes_nothing(extended):
    """Extending a plan again changes nothing, even after a person changed or removed a dwell."""
    _, plan, submission = extended
    assert extend_plan(plan, submission) == plan
    first, *rest = plan.recordings
    edited = plan.model_copy(
        update={"recordings": (first.model_copy(update={"amplitude": 1e-3}), *rest[:-3])}
    )
    assert extend_plan(edited, submission) == edited


@pytest.mark.slow
@pytest.mark.sample
def test_the_loop_comes_once_the_dwells_are_recorded():
    """A closed loop is planned only once the dwells are recorded."""
    before, after = recorded("two-cart", *FIRST), recorded("two-cart", *FIRST, "sine")
    plan = propose_plan(before)
    assert of_kind(extend_plan(plan, before), "closed_loop") == []
    extended = extend_plan(plan, after)
    (loop,) = extended.recordings
    assert loop.controller == StateLoop(cart=2)
    assert loop.amplitude == 1.0
    assert extend_plan(extended, after) == extended


def test_a_long_set_point_is_cut_to_the_travel():
    """A set point beyond the travel limit is reduced."""
    submission = recorded("two-cart", *FIRST, "sine")
    plan = Plan(limits=PlanLimits(input=5.0, travel=0.5))
    (loop,) = extend_plan(plan, submission).recordings
    assert 0.2 < loop.amplitude < 0.4


def test_data_that_identify_nothing_give_a_reason():
    """If the data identify nothing, there are no dwells, and a reason is given."""
    submission = recorded("one-cart", "sweep")
    rigid = submission.system.model_copy(update={"springs": (False, False)})
    submission = submission.model_copy(update={"system": rigid})
    with pytest.raises(DataError, match="need identified carts"):
        extend_plan(propose_plan(submission), submission)


# --------------------------------------------------------------------- the file

finite = st.floats(-1e6, 1e6, allow_nan=False).map(lambda x: round(x, 6))
positive = st.floats(1e-3, 1e3).map(lambda x: round(x, 6))


@given(
    input=positive,
    travel=positive,
    frequency=st.floats(0.01, 50).map(lambda x: round(x, 4)),
    kp=finite,
    cycles=st.integers(1, 5),
    note=st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
)
def test_a_plan_reads_back_as_it_was_written(
    tmp_path_factory, input, travel, frequency, kp, cycles, note
):
    """Every key of a plan survives writing and reading, and equal plans give equal bytes."""
    submission = bare().model_copy(update={"folder": tmp_path_factory.mktemp("plan")})
    common = {"frequency": frequency, "cycles": cycles, "note": note}
    loops = (
        PidLoop(kp=kp, cart=2),
        StateLoop(cart=2),
        StateLoop(gains=(kp, 0.0, 1.0, 2.0), prefilter=-1.0),
    )
    runs: list[dict[str, object]] = [
        {"kind": "decay", "carts": (2,), "wave": "delta", "amplitude": 0, "release": 2},
        {"kind": "sweep", "wave": "chirp", "amplitude": -input, "frequency_end": 60.0, "settle": 0},
        *({"kind": "closed_loop", "wave": "square", "amplitude": travel, "controller": loop}
          for loop in loops),
    ]  # fmt: skip
    recordings = tuple(
        Recording.model_validate({"id": f"run-{i}", "carts": (1, 2), **common, **one})
        for i, one in enumerate(runs)
    )
    limits = PlanLimits(input=input, travel=travel)
    plan = Plan(baud=9600, limits=limits, recordings=recordings)
    path = save_plan(plan, submission)
    assert load_plan(submission) == plan
    assert path.read_text(encoding="utf-8") == plan_text(plan, submission.system)


def test_adding_keeps_every_byte_of_the_file(tmp_path):
    """Adding recordings changes nothing that is in the file; new ones come last."""
    example = recorded("two-cart", *FIRST)
    submission = example.model_copy(update={"folder": tmp_path})
    plan_path(submission).write_text(
        "version = 1 # mine\n[limits] # measured\ntravel = 3\r\ninput = 4.5",
        encoding="utf-8",
        newline="",
    )
    old = load_plan(submission)
    assert old.limits == PlanLimits(input=4.5, travel=3.0)

    save_plan(extend_plan(old, example), submission)

    text = plan_path(submission).read_bytes().decode("utf-8")
    assert text.startswith("version = 1 # mine\n[limits] # measured\ntravel = 3\r\ninput = 4.5\n")
    assert len(of_kind(load_plan(submission), "sine")) > 20
    with pytest.raises(ValueError, match="not an extension"):
        save_plan(old, submission)


def test_a_recording_added_meanwhile_is_kept(tmp_path):
    """A recording that is added while `plan` analyses the data is kept."""
    work = a_recorded_cart(tmp_path / "work")
    submission = load_submission(work)
    old = propose_plan(submission)
    save_plan(old, submission)
    mine = release_by_hand(1, name="mine", seconds=10.0)

    def meanwhile(stage: str) -> None:
        add_recording(work, mine)

    message, _ = make_plan(submission, progress=meanwhile)
    n, plan = len(old.recordings), load_plan(submission)
    assert plan.recordings[: n + 1] == (*old.recordings, mine)
    assert f" {len(plan.recordings) - n - 1} recording" in message
    assert of_kind(plan, "sine")


RUN = """
[[recordings]]
id = "{id}"
kind = "{kind}"
carts = {carts}
wave = "{wave}"
amplitude = {amplitude}
frequency = {frequency}
{more}
"""
GOOD: dict[str, object] = {
    "id": "run", "kind": "step", "carts": "[1, 2]", "wave": "square", "amplitude": 0.2,
    "frequency": 0.1, "more": "",
}  # fmt: skip


LOOP = {"kind": "closed_loop", "amplitude": 1.0}


def with_run(**changes) -> str:
    return "version = 1\n[limits]\ninput = 5\ntravel = 2.5\n" + RUN.format(**{**GOOD, **changes})


LIMITED = "version = 1\n[limits]\ninput = {}\ntravel = 2"
PID = 'controller = {{type = "pid", {}}}'
STATE = 'controller = {{type = "state_feedback", {}}}'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version = 1\n[limit]\n", r"limit: unknown key; did you mean 'limits'"),
        ("version = 2\n[limits]\ninput = 1\ntravel = 2", "version: expected 1"),
        ("version = 1\nlimits = [", "not valid TOML"),
        *((LIMITED.format(value), r"limits\.input: ") for value in ("0", "nan")),
        *(
            (with_run(more=more), rf"recordings\[1\]\.{key} \(run\): ")
            for key, more in [
                ("cycle", "cycle = 2"),
                ("cycles", "cycles = 2.5"),
                ("cycles", "cycles = 61"),
                ("settle", "settle = 1e-4"),
                ("settle", "settle = 1001"),
                ("release", "release = 3"),
                ("frequency_end", "frequency_end = 9"),
                ("controller", PID.format("kp = 1")),
            ]
        ),
        *(
            (with_run(**change), rf"recordings\[1\]\.{key} \(")
            for key, change in [
                ("kind", {"kind": "steps"}),
                ("wave", {"wave": "sqare"}),
                ("wave", {"wave": "sine"}),
                ("id", {"id": "../up"}),
                ("carts", {"carts": "[1, 3]"}),
                ("amplitude", {"carts": "[2]"}),
                ("amplitude", {"carts": "[2]", "amplitude": -0.2}),
                ("amplitude", {"amplitude": 6}),
                ("amplitude", {"amplitude": 0}),
                ("frequency", {"frequency": 2000}),
                ("frequency_end", {"wave": "chirp"}),
                (
                    "frequency_end",
                    {"kind": "sweep", "wave": "chirp", "more": "frequency_end = 5e-4"},
                ),
            ]
        ),
        *(
            (with_run(**LOOP, more=more), rf"recordings\[1\]\.{key} \(run\): ")
            for key, more in [
                ("controller", ""),
                ("controller", 'controller = {type = "pd"}'),
                (r"controller\.kp", PID.format("kd = 1")),
                (r"controller\.k", PID.format("kp = 1, k = 1")),
                (r"controller\.gains", STATE.format("gains = [1.0]")),
                ("controller", STATE.format("prefilter = 1.0")),
                (r"controller\.cart", STATE.format("cart = 3")),
            ]
        ),
        (with_run() + RUN.format(**{**GOOD, "id": "RUN"}), r"recordings\[2\]\.id "),
        *((with_run(id=name), rf"\.id .*\b{name}\b") for name in ("aux", "Con.1")),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(tmp_path, text, message):
    """A mistake in the plan gives one line: file, key, what was expected, what was found."""
    submission = bare().model_copy(update={"folder": tmp_path})
    plan_path(submission).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        load_plan(submission)
    assert all(
        line.startswith(f"{tmp_path.name}/plan.toml") for line in str(caught.value).split("\n")
    )


# ------------------------------------------------------------------- the command


def test_the_command_writes_shows_and_extends(tmp_path):
    """`plan` says which carts to hold and how long it takes; a second run changes nothing."""
    new_submission(tmp_path / "bench", carts=2)
    first = cartlab_here("plan", tmp_path / "bench")
    assert first.returncode == 0
    for told in ("hold cart 2", "all carts", "7 recordings", "1 min 59 s"):
        assert told in first.stdout
    assert "[limits]" in first.stderr
    raw = (tmp_path / "bench" / "plan.toml").read_bytes()

    again = cartlab_here("plan", tmp_path / "bench", "--json")
    data = json.loads(again.stdout)
    assert data["recordings"][0]["held"] == [2]
    assert data["seconds_left"] == pytest.approx(119.0)
    assert "0 recordings" in again.stderr
    assert (tmp_path / "bench" / "plan.toml").read_bytes() == raw
