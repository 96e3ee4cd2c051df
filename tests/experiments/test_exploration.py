"""A bench explores itself, with the emulator's carts and over a real line."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.bench.events import Stopped
from pipeline.bench.raw import known_commands
from pipeline.errors import ConfigError, DataError
from pipeline.experiments.discriminate import propose_for
from pipeline.experiments.exploration import (
    Exploration,
    Recorded,
    list_explanations,
)
from pipeline.experiments.information import (
    ErrorGoal,
    FisherInformation,
    find_goal,
    read_error_goal,
    read_time,
)
from pipeline.experiments.next_recordings import propose_candidates
from pipeline.experiments.plan import (
    PlanLimits,
    Recording,
    load_plan,
    save_plan,
    session_time,
    time_words,
)
from pipeline.experiments.propose import add_recording, propose_plan
from pipeline.report.exploration import NAME, write_diary
from pipeline.results import Analysis
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from pipeline.words.progress import Progress, silent
from pipeline.workflow import analyse
from tests.helpers.benches import emulator
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import a_recorded_cart
from tests.helpers.virtual import VirtualBench, VirtualSession, new_folder

FAR = ErrorGoal(error=1e-7)  # further than these sessions come


def exploration(
    folder: Path,
    record: Callable[[Sequence[str]], Recorded],
    *,
    goal: ErrorGoal = FAR,
    seconds: float = 400.0,
    announce: Progress = silent,
    progress: Progress = silent,
    vetoes: Callable[[Recording], bool] = lambda recording: False,
) -> Exploration:
    """Return an exploration that wants errors of 1e-7, unless told otherwise."""
    return Exploration(
        write_diary=write_diary,
        known_commands=known_commands,
        folder=folder,
        record=record,
        goal=goal,
        seconds=seconds,
        announce=announce,
        progress=progress,
        vetoes=vetoes,
    )


def bench_of(*hide: str, seed: int = 1) -> VirtualBench:
    """Return a bench of one cart with these hidden effects."""
    return VirtualBench(prepare_bench(preset="throne-1dof", model=None, hide=[*hide]), seed=seed)


def linear_session(folder: Path) -> VirtualSession:
    """Return a session on a bench of one cart without hidden effects."""
    return VirtualSession(folder, bench_of())


@pytest.mark.parametrize(
    ("text", "wish"),
    [
        ("zeta 1%", ErrorGoal(prefix="zeta", error=0.01)),
        ("1 %", ErrorGoal(error=0.01)),
        ("all 0.5%", ErrorGoal(error=0.005)),
        ("omega_1 0.05 %", ErrorGoal(prefix="omega_1", error=0.0005)),
        *(("90s", 90), ("20min", 1200), ("20 min", 1200), ("1.5h", 5400)),
    ],
)
def test_goals_and_durations_are_read_from_text(text, wish):
    """A goal is a percentage, with or without a name; a duration has s, min or h."""
    assert (read_error_goal if "%" in text else read_time)(text) == wish


@pytest.mark.parametrize(
    ("read", "text"),
    [
        *((read_error_goal, text) for text in ("zeta", "zeta 1", "zeta omega 1%", "1.5", "0%",
                                               "200%", "%", "zeta 1% K 2%")),
        *((read_time, text) for text in ("20", "min", "-3s", "20 parsec", "inf s", "1e999s",
                                         "1e308h", "nan s")),
    ],
)  # fmt: skip
def test_a_text_that_is_neither_is_refused(read, text):
    """A text that is not a goal or a duration is refused with what was expected."""
    with pytest.raises(ConfigError, match="expected"):
        read(text)


@pytest.mark.slow
@pytest.mark.sample
def test_with_backlash_no_accuracy_is_claimed(tmp_path):
    """No standard error is stated, so nothing is reached and no recording is meant to lower one."""
    folder = tmp_path / "work"
    session = VirtualSession(folder, bench_of("backlash"))
    turns = exploration(folder, session, goal=ErrorGoal(), seconds=600.0).run()
    last = turns[-1]
    assert last.gap is not None
    assert "backlash" in [one.effect.key for one in last.gap.effects]
    assert set(last.errors.values()) == {None}
    assert not last.reached
    assert "No standard errors can be stated" in last.summary
    assert last.seconds < 200.0


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """Return the exploration of a bench with an end stop on one side that no step reaches."""
    bench = prepare_bench(preset="throne-1dof", model=None, hide=["end_stop:position=-1.7"])
    folder = tmp_path_factory.mktemp("explored") / "work"
    said: list[str] = []
    session = VirtualSession(folder, VirtualBench(bench, seed=2))
    turns = exploration(folder, session, goal=read_error_goal("all 1%"), announce=said.append).run()
    return folder, turns, said, bench


@pytest.mark.slow
@pytest.mark.sample
def test_an_exploration_names_the_effect_and_finds_the_carts(explored):
    """The exploration names the end stop on its cart, and finds every parameter correctly."""
    folder, turns, said, bench = explored
    last = turns[-1]
    assert last.gap is not None
    assert last.gap.verdict == "named"
    assert last.reached
    assert last.recorded == ("sweep-2",)  # the second sweep reaches the end stop
    ((name, _),) = list_explanations(last.gap)
    assert "cart 1" in name
    assert all(error is not None and error < 0.01 for error in last.errors.values())
    gap = json.loads((folder / "gap" / "gap.json").read_text(encoding="utf-8"))
    assert [one["effect"] for one in gap["effects"]] == ["end_stop"]
    m = gap["chain"]["m"][0]
    assert m == pytest.approx(bench.chain.m[0], rel=0.01)
    assert said == [turn.summary for turn in turns]


@pytest.mark.slow
@pytest.mark.sample
def test_an_exploration_writes_a_submission_and_a_diary(explored):
    """Every record is in submission.toml and plan.toml, and the diary shows each decision."""
    folder, turns, _, _ = explored
    recorded = [name for turn in turns for name in turn.recorded]
    submission = load_submission(folder)
    assert [experiment.id for experiment in submission.experiments] == recorded
    assert analyse(submission).records
    diary = (folder / NAME).read_text(encoding="utf-8").replace("\u00a0", " ")
    for turn in turns:
        assert f"{turn.seconds:.0f} s" in diary


@pytest.fixture
def no_gap(monkeypatch):
    """Make the search for the gap fail, so that only the carts are identified."""

    def none(analysis, **other):
        raise DataError("no run can be held out")

    monkeypatch.setattr("pipeline.experiments.exploration.investigate", none)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("no_gap")
def test_an_exploration_ends_before_it_exceeds_its_time(tmp_path):
    """A recording that would exceed the time is not begun, and the diary names it.

    If the gap analysis fails, the carts are still identified, and no effect is named.
    """
    session = linear_session(tmp_path / "work")
    (turn,) = exploration(tmp_path / "work", session, seconds=90.0).run()
    assert turn.seconds <= 90.0
    assert (turn.gap, turn.reached) == (None, False)
    assert turn.errors
    assert "run out" in turn.summary


def test_too_little_time_for_the_sweep_moves_no_cart(tmp_path):
    """If the time is too short for the first sweep, nothing is recorded, and a message says so."""
    virtual = bench_of()
    session = VirtualSession(tmp_path / "work", virtual)
    with pytest.raises(ConfigError, match="sweep"):
        exploration(tmp_path / "work", session, goal=ErrorGoal(), seconds=10.0).run()
    assert virtual.seconds == 0.0


def test_a_goal_for_an_unknown_parameter_is_refused(tmp_path):
    """A goal for a parameter that does not exist is refused with the nearest name."""
    asked: list[str] = []

    def record(ids):
        asked.extend(ids)
        return Recorded(ids=(), seconds=0.0)

    wish = read_error_goal("Zeta 1%")
    known = a_recorded_cart(tmp_path / "known")
    for folder in (known, tmp_path / "unknown"):  # with known carts, and with unknown ones
        with pytest.raises(ConfigError, match="mean 'zeta'"):
            exploration(folder, record, goal=wish, seconds=900.0).run()
    assert not asked
    with pytest.raises(ConfigError, match="parameter"):
        ErrorGoal(prefix="zeta_7").missing({"zeta_1": 0.1, "zeta_2": None})


@pytest.mark.usefixtures("no_gap")
def test_an_exploration_ends_after_three_failures(tmp_path):
    """If three recordings fail, an exploration ends, and the diary says what failed and why."""
    asked = []

    def record(ids):
        asked.extend(ids)
        return Recorded(ids=(), seconds=20.0, why="the line is silent: is it plugged in?")

    turns = exploration(a_recorded_cart(tmp_path / "work"), record, seconds=900.0).run()
    assert len(set(asked)) == 3
    for turn, name in zip(turns[1:], asked, strict=True):
        assert turn.summary.startswith(f"{name} failed: ")
        assert "line is silent" in turn.summary
    assert not turns[-1].reached


@pytest.mark.slow
@pytest.mark.sample
def test_a_person_vetoes_and_adds(tmp_path, monkeypatch):
    """A recording that a person vetoes is replaced, and one that is added comes next.

    gap.json is then written again with a new proposal in place of the vetoed one.
    """
    folder, offered, said = tmp_path / "work", [], []
    session = linear_session(folder)

    def proposed(gap, submission, *, without=()):
        found = propose_for(gap, submission, without=without)
        return replace(found, next_experiment="another") if without else found

    def vetoes(recording):
        offered.append(recording)
        gap = json.loads((folder / "gap" / "gap.json").read_text(encoding="utf-8"))
        assert (gap["next_experiment"] == "another") == (len(offered) >= 2)  # after a new search
        if len(offered) == 1:
            step = next(one for one in load_plan(load_submission(folder)).recordings
                        if one.kind == "step")  # fmt: skip
            add_recording(folder, step.model_copy(update={"id": "mine", "amplitude": 0.015}))
        elif len(offered) == 3:
            raise Stopped("by hand")
        return len(offered) == 1

    monkeypatch.setattr("pipeline.experiments.exploration.propose_for", proposed)
    with pytest.raises(Stopped):
        exploration(folder, session, announce=said.append, vetoes=vetoes).run()
    first, mine, other = offered
    assert mine.id == "mine"
    assert not other.resembles(first)
    recorded = {experiment.id for experiment in load_submission(folder).experiments}
    assert mine.id in recorded
    assert first.id not in recorded
    for told in (said[1], (folder / NAME).read_text(encoding="utf-8")):
        assert f"{first.id} was vetoed" in told
    assert "mine," in said[1]


@pytest.mark.slow
@pytest.mark.sample
def test_an_added_recording_comes_next_whatever_its_id(tmp_path):
    """A recording that a person adds comes next, even with the id of the program's own step."""
    bench = bench_of()
    folder = new_folder(tmp_path / "work", bench, springs=[True, True])
    submission = load_submission(folder)
    usual = propose_plan(submission, bench=bench.description)
    sweep, step = (next(one for one in usual.recordings if one.id == name)
                   for name in ("sweep", "step-1"))  # fmt: skip
    save_plan(usual.model_copy(update={"recordings": (sweep,)}), submission)
    session, offered = VirtualSession(folder, bench), []
    session(["sweep"])

    def add(stage):
        if stage == "what to record next":
            add_recording(folder, step)

    def enough(recording):
        offered.append(recording)
        raise Stopped("by hand")

    with pytest.raises(Stopped):
        exploration(folder, session, progress=add, vetoes=enough).run()
    assert offered == [step]


def chosen(analysis: Analysis, folder: Path, *, wanted=1e-7, seconds=900.0, refused=()):
    """Return the recordings chosen for ζ within the limits of the plan, and why."""
    goal = ErrorGoal(prefix="zeta", error=wanted)
    known = exploration(folder, lambda ids: Recorded(), goal=goal, seconds=seconds)
    known.known_commands = lambda folder: frozenset("c")
    known.analysis, known.gap, known.refused = analysis, None, [*refused]
    return known.choose({"zeta": 0.1})


def planned_cart(folder: Path, *, limits: PlanLimits | None = None) -> tuple[Path, Analysis]:
    """Return a recorded cart with a plan, and its analysis."""
    submission = load_submission(a_recorded_cart(folder))
    plan = propose_plan(submission)
    save_plan(plan.model_copy(update={"limits": limits or plan.limits}), submission)
    return folder, analyse(submission)


def test_a_large_step_is_proposed_after_all_else_was_refused(tmp_path):
    """After all better proposals were refused, a large step is proposed."""
    limits = PlanLimits(input=100.0, travel=100.0)
    folder, analysis = planned_cart(tmp_path / "work", limits=limits)
    goal = find_goal("zeta", known := FisherInformation.of(analysis), feedback=None)
    refused = propose_candidates(known, limits=limits, commands=frozenset("c"), goal=goal)
    (step,), _ = chosen(analysis, folder, refused=refused)
    assert step.aim == "far"


@pytest.mark.slow
@pytest.mark.sample
def test_the_number_of_chosen_recordings_grows_with_the_data(tmp_path):
    """A tenth of the data so far is chosen at once, but no more than goal and time need."""
    folder, analysis = planned_cart(tmp_path / "work")
    often = replace(analysis, records=analysis.records * 12)

    several, why = chosen(often, folder)
    assert len(several) == len(often.records) // 10 >= 3
    assert time_words(session_time(several)) in why
    assert len(chosen(analysis, folder)[0]) == 1
    assert len(chosen(often, folder, wanted=0.09)[0]) == 1
    assert chosen(often, folder, seconds=session_time(several[:2]))[0] == several[:2]
    assert len(chosen(often, folder, seconds=1.0)[0]) == 1


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.usefixtures("no_gap")
@pytest.mark.parametrize("ends", ["not", "added", "vetoed"])
def test_a_series_ends_when_a_person_intervenes(tmp_path, monkeypatch, ends):
    """Chosen recordings are made and then analysed together; a veto or an addition ends this."""
    monkeypatch.setattr("pipeline.experiments.exploration._SHARE", 1.0)
    folder, asked = tmp_path / "work", []
    session = linear_session(folder)

    def vetoes(recording):
        asked.append(recording.id)
        if len(asked) == 2 and ends == "added":
            add_recording(folder, recording.model_copy(update={"id": "mine"}))
        if "mine" in asked or len(asked) > 3:
            raise Stopped("by hand")
        return len(asked) == 3 and ends == "vetoed"

    series = exploration(folder, session, seconds=600.0, vetoes=vetoes)
    with pytest.raises(Stopped):
        series.run()
    first, second = series.turns
    assert f"{asked[0]}, {asked[1]}" in first.summary
    assert second.recorded == tuple(asked[:3] if ends == "not" else asked[:2])
    assert second.summary.startswith(f"{asked[2]} was" if ends == "vetoed" else "")
    assert (asked[2] == "mine") == (ends == "added")


def test_thinking_can_be_ended(tmp_path):
    """An exception in the progress display ends the exploration, and the recordings stay."""
    session = linear_session(tmp_path / "work")

    def enough(stage):
        raise Stopped("by hand")

    with pytest.raises(Stopped):
        exploration(
            tmp_path / "work", session, goal=ErrorGoal(), seconds=90.0, progress=enough
        ).run()
    assert len(load_submission(tmp_path / "work").experiments) == 3


@pytest.mark.slow
@pytest.mark.sample
def test_the_command_explores_a_bench_over_its_line(tmp_path):
    """`cartlab explore` makes a submission with its diary from an empty folder, over a socket.

    The time limit also holds for the first recordings: the sweep fits, but the steps do not.
    """
    folder = tmp_path / "work"
    with emulator("--speed", "8", "--port", "socket://127.0.0.1:0", preset="throne-1dof") as bench:
        done = cartlab_here(
            "explore", folder, "--port", bench.address, "--until", "all 5%", "--time", "40s"
        )
    assert done.returncode == 1, done.stderr
    assert (folder / NAME).exists()
    assert [e.kind for e in load_submission(folder).experiments] == ["sweep"]
    assert "run out" in done.stderr


@contextmanager
def busy_computer(processes: int) -> Iterator[None]:
    """Keep the processors busy while the block runs."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_busy_computer_and_a_slow_bench_give_the_same_answer(tmp_path):
    """The same bench gives the same data, choices and gap, whatever the clock says meanwhile."""
    answers = []
    for processes, speed in ((0, "10"), (2, "6")):
        folder = tmp_path / str(processes) / "work"
        folder.parent.mkdir()
        stop = ("--hide", "end_stop:position=-1.7", "--seed", "2", "--speed", speed)
        with busy_computer(processes), emulator(*stop, preset="throne-1dof") as bench:
            limits = ("--until", "all 1%", "--time", "110s")
            done = cartlab_here("explore", folder, "--port", bench.address, *limits)
        assert done.returncode == 1, done.stderr
        files = [folder / "plan.toml", folder / "gap" / "gap.json", *(folder / "data").iterdir()]
        answers.append({file.name: file.read_text(encoding="utf-8") for file in files})
    calm, busy = answers
    assert len(calm) >= 2 + 4  # plan, gap, the first three recordings and a chosen one
    assert calm == busy


@pytest.mark.slow
def test_the_large_step_and_the_far_sweep_are_made_only_once(tmp_path):
    """If drag keeps carts from the wanted distance, the recordings for it are still made once."""
    session = VirtualSession(tmp_path / "work", bench_of("quadratic_drag", seed=13))
    turns = exploration(tmp_path / "work", session, goal=ErrorGoal(), seconds=300.0).run()
    assert [turn.gap and turn.gap.verdict for turn in turns] == ["named"] * 3
    assert [turn.recorded for turn in turns[1:]] == [("step-3",), ("sweep-2",)]
