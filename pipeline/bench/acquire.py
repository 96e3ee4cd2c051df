"""Record the plan of a submission on a bench, or explore it, while people watch and intervene.

A later session continues where this one ended.
"""

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipeline.bench.events import (
    Action,
    Buttons,
    Observer,
    RunOutcome,
    Stopped,
    signals_held,
    stopping_on_signals,
)
from pipeline.bench.experiments import (
    add_experiment,
    cart_remarks,
    check_files,
    limit_words,
    prepare_submission,
    recorded_entry,
    save_left_over,
    save_record,
    scale_remarks,
)
from pipeline.bench.orders import Order, order_on
from pipeline.bench.raw import free_raw_path, known_commands
from pipeline.bench.run import Session
from pipeline.bench.serial_line import Runaway, SerialLine, open_line
from pipeline.errors import ConfigError, DataError, HardwareError, PipelineError
from pipeline.experiments.exploration import Exploration, Recorded, Turn
from pipeline.experiments.information import ErrorGoal
from pipeline.experiments.plan import (
    Plan,
    Recording,
    add_recordings,
    load_plan,
    plan_path,
    save_plan,
    session_time,
)
from pipeline.experiments.propose import extend_plan, propose_plan
from pipeline.lock import lock_or_refuse
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME
from pipeline.submission.toml import Value
from pipeline.words.text import with_symbols

_USUAL_BAUD = 115_200
_TRIES = 3  # attempts per recording; a fault that occurs three times is no accident


def acquire(
    folder: Path,
    *,
    port: str,
    observer: Observer,
    only: Collection[str] = (),
    buttons: Buttons | None = None,
) -> tuple[RunOutcome, ...]:
    """Record the planned experiments still missing in the submission; return how each run ended.

    Every complete run is entered in submission.toml at once, so an interrupted session can be
    continued. The data of a run that ended early are saved separately, and the run is repeated.

    Parameters
    ----------
    port : name of the serial port, or a URL that pyserial knows.
    observer : receives the events of the session, and asks a person to do the work at the bench.
    only : ids of the recordings to make. By default the whole plan; dwells and a closed loop
        are added once the data are sufficient.
    buttons : the buttons with which a person ends or repeats a run.

    Raises
    ------
    Stopped : a signal or a button ended the session; call again to continue it.
    HardwareError : no bench answers.
    Runaway : the bench's motor was on between runs.
    ConfigError : another session writes to the folder, or the plan or submission does not fit the
        bench. If only one recording does not fit, its outcome says why, and the session continues.
    """
    with stopping_on_signals(), lock_or_refuse(folder):
        work = _Acquisition(
            folder, port=port, observer=observer, only=only, buttons=buttons or Buttons()
        )
        return tuple(work.outcomes())


def ensure_plan(folder: Path, *, port: str) -> None:
    """Write a plan for a submission without one, within the limits of the bench at the port.

    Raises
    ------
    HardwareError : no bench answers.
    """
    submission = load_submission(folder)
    if not plan_path(submission).exists():
        with lock_or_refuse(folder), open_line(port, baud=_USUAL_BAUD) as line:
            save_plan(propose_plan(submission, bench=line.bench), submission)


class _Acquisition:
    def __init__(
        self,
        folder: Path,
        *,
        port: str,
        observer: Observer,
        only: Collection[str],
        buttons: Buttons,
    ) -> None:
        self._folder = folder
        self._port = port
        self._observer = observer
        self._only = frozenset(only)
        self._buttons = buttons
        self._failed: dict[str, int] = {}  # number of failed attempts at each recording

    def outcomes(self) -> Iterator[RunOutcome]:
        """Record until the plan is done, reconnecting if necessary; yield how each run ended."""
        lost = True
        while lost:
            with open_line(self._port, baud=self._baud()) as line:
                with line.watched(self._observer.remark):
                    lost = yield from self._on_line(line)

    def _baud(self) -> int:
        if not (self._folder / NAME).exists():
            return _USUAL_BAUD
        submission = load_submission(self._folder)
        return load_plan(submission).baud if plan_path(submission).exists() else _USUAL_BAUD

    def _on_line(self, line: SerialLine) -> Generator[RunOutcome, None, bool]:
        """Record on one open line; return whether the line was lost."""
        bench = line.bench
        new = not (self._folder / NAME).exists()
        submission = prepare_submission(self._folder, bench, stock=not bench.commands)
        if new:
            self._observer.remark(
                f"wrote {self._folder / NAME}: check its springs, which the bench does not know; "
                "add the authors and the design goal"
            )
        if not line.knows("k"):
            self._observer.remark(
                f"the bench {bench.name!r} has no watchdog: if this program stops or the cable "
                "fails in a run, the motor runs on; keep a hand on its switch"
            )
        for sentence in (*cart_remarks(submission, bench), *scale_remarks(submission, bench)):
            self._observer.remark(sentence)
        for file in save_left_over(self._folder, carts=submission.system.carts):
            self._observer.remark(f"{file} holds the data of an interrupted session")
        plan = self._plan(submission, line)
        session = Session(
            line,
            carts=submission.system.carts,
            limits=plan.limits,
            observer=self._observer,
            buttons=self._buttons,
        )
        self._observer.planned(plan, _done(submission))
        while True:
            self._buttons.begin()
            self._heed_stop()
            recording = self._next(plan, submission)
            if recording is None:
                longer = plan if self._only else self._extended(plan, submission, line)
                if longer is plan:
                    line.part()
                    return False
                plan = longer
                self._observer.planned(plan, _done(submission))
                continue
            run = self._record(recording, plan, submission, session, line)
            yield run.outcome
            if run.outcome.is_astray:
                self._say_astray(run)
                return False
            if run.outcome.partial:
                if self._wish(run) == "keep":
                    yield self._keep(run)
                if _is_lost(line):
                    return True
            submission = load_submission(self._folder)

    def _say_astray(self, run: "_Run") -> None:
        if run.file:
            self._observer.remark(f"{run.file} is partial; it is not in {NAME}")
        self._observer.remark(
            "the session ends here, because the bench acted without an order; "
            "switch its motor off and find out why"
        )

    def _heed_stop(self) -> None:
        if self._buttons.pressed == "stop":
            raise Stopped("by hand")

    def _wish(self, run: "_Run") -> Action:
        """Return what to do with a run that ended early.

        After an unsafe run, the recording is skipped. Otherwise, a person decides.
        """
        name, partial = run.outcome.recording.id, run.outcome.partial
        unsafe = run.outcome.is_unsafe
        if run.file and (unsafe or self._buttons.pressed != "keep"):
            self._observer.remark(f"{run.file} is partial ({partial}); it is not in {NAME}")
        if unsafe:  # a second try would be just as unsafe
            self._failed[name] = _TRIES
            less = (
                "divide the amplitude in plan.toml by four"
                if run.outcome.recording.amplitude
                else "pull the cart out less far"
            )
            self._observer.remark(
                f"{name} is not tried again in this session. If a limit was exceeded, {less}. If "
                "the bench has room for more, raise the limit in plan.toml instead"
            )
            return "skip"
        wish = self._buttons.pressed or self._answer(run)
        self._heed_stop()
        if wish == "skip" or (wish == "keep" and not run.file):
            self._failed[name] = _TRIES
            return "skip"
        return wish

    def _answer(self, run: "_Run") -> Action:
        """Ask a person whether to repeat a recording, unless it has failed too often."""
        name = run.outcome.recording.id
        self._failed[name] = self._failed.get(name, 0) + 1
        if self._failed[name] >= _TRIES:
            return "skip"
        offered: list[Action] = ["repeat", "keep", "skip"] if run.file else ["repeat", "skip"]
        self._buttons.offer(*offered)
        try:
            self._observer.confirm(
                f"{name} ended early: {run.outcome.partial}. Record {name} again"
            )
        except ConfigError:  # nobody answers: continue with the other recordings
            return "skip"
        return self._buttons.pressed or "repeat"

    def _keep(self, run: "_Run") -> RunOutcome:
        """Enter a run that ended early as an experiment, and note why it ended."""
        remark = f"partial, kept by hand: {run.outcome.partial}"
        outcome = replace(run.outcome, partial="", remarks=(*run.outcome.remarks, remark))
        with signals_held():
            self._note(replace(run, outcome=outcome))
            # The new data file has the same lines as the partial one.
            (self._folder / run.file).unlink()
        self._observer.finished(outcome)
        return outcome

    def _note(self, run: "_Run") -> None:
        """Write the data file of a run, and its table in submission.toml."""
        submission = load_submission(self._folder)
        file = save_record(run.path, folder=self._folder, carts=submission.system.carts)
        outcome = run.outcome
        entry = recorded_entry(
            outcome.recording, file=file, controller=run.controller, remarks=outcome.remarks
        )
        add_experiment(submission, entry)

    def _plan(self, submission: Submission, line: SerialLine) -> Plan:
        if plan_path(submission).exists():
            plan = load_plan(submission)
        else:
            plan = propose_plan(submission, bench=line.bench)
            path = save_plan(plan, submission)
            self._observer.remark(f"wrote {path}: check it")
        self._observer.remark(limit_words(plan.limits, submission, line.bench))
        known = {recording.id for recording in plan.recordings}
        if unknown := sorted(self._only - known):
            raise ConfigError(
                f"--only {unknown[0]}: no such recording; plan.toml has {', '.join(sorted(known))}"
            )
        check_files(plan, submission)
        return plan

    def _next(self, plan: Plan, submission: Submission) -> Recording | None:
        done = _done(submission)
        for recording in plan.recordings:
            wanted = not self._only or recording.id in self._only
            given_up = self._failed.get(recording.id, 0) >= _TRIES
            if wanted and recording.id not in done and not given_up:
                return recording
        return None

    def _extended(self, plan: Plan, submission: Submission, line: SerialLine) -> Plan:
        try:
            longer = extend_plan(plan, submission, bench=line.bench)
        except DataError as error:
            self._observer.remark(f"the plan is not extended: {error}")
            return plan
        new = longer.recordings[len(plan.recordings) :]
        if not new:
            return plan
        longer = add_recordings(self._folder, new, otherwise=plan)
        check_files(longer, submission)
        return longer

    def _record(
        self,
        recording: Recording,
        plan: Plan,
        submission: Submission,
        session: Session,
        line: SerialLine,
    ) -> "_Run":
        """Record one experiment and enter it in submission.toml."""
        path = free_raw_path(self._folder, recording)
        try:
            order, table = order_on(recording, plan, submission, line.bench)
        except PipelineError as error:  # the bench cannot or must not do this: send nothing
            self._failed[recording.id] = _TRIES
            return self._refused(RunOutcome(recording=recording, lines=0, partial=str(error)), path)
        try:
            restless = session.prepare(order)
            # Signals wait until a complete run is entered in submission.toml.
            with signals_held() as let_in:
                outcome = self._run(session, order, path, submission, let_in)
                remarks = [restless] if restless else []
                # Late lines have correct time stamps, so they do not harm the data.
                if (spoilt := str(replace(outcome.anomalies, late=0))) != "none":
                    remarks.append(spoilt)
                run = _Run(
                    outcome=replace(outcome, remarks=tuple(remarks)), path=path, controller=table
                )
                if outcome.partial:
                    run = replace(run, file=self._saved_partial(path, submission))
                else:
                    self._note(run)
                self._observer.finished(run.outcome)
        except HardwareError as error:
            outcome = RunOutcome(
                recording=recording,
                lines=0,
                partial=str(error),
                is_astray=isinstance(error, Runaway),
                wish=session.wish,
            )
            return self._refused(outcome, path)
        return run

    def _run(
        self,
        session: Session,
        order: Order,
        path: Path,
        submission: Submission,
        let_in: Callable[[], None],
    ) -> RunOutcome:
        try:
            return session.record(order, path, let_in=let_in)
        except KeyboardInterrupt:
            if file := self._saved_partial(path, submission):
                self._observer.remark(f"{file} is partial (stopped by hand); it is not in {NAME}")
            raise

    def _refused(self, outcome: RunOutcome, path: Path) -> "_Run":
        """Report a recording that was not started."""
        self._observer.finished(outcome)
        return _Run(outcome=outcome, path=path)

    def _saved_partial(self, path: Path, submission: Submission) -> str:
        """Save the data of a run that ended early, in a file that no report uses.

        Returns the name of the file, or "" if there are no data.
        """
        if not path.exists():
            return ""
        try:
            return save_record(
                path, folder=self._folder, carts=submission.system.carts, partial=True
            )
        except DataError:
            return ""


@dataclass(frozen=True, kw_only=True)
class _Run:
    """One attempt at a recording.

    Attributes
    ----------
    path : path of the raw file, which exists if the run began.
    file : name of the data file of a run that ended early; "" if it has no file.
    controller : controller of a closed loop, as written in submission.toml.
    """

    outcome: RunOutcome
    path: Path
    file: str = ""
    controller: dict[str, Value] | None = None


def _done(submission: Submission) -> frozenset[str]:
    return frozenset(experiment.id for experiment in submission.experiments)


def _is_lost(line: SerialLine) -> bool:
    try:
        line.stop()
        line.clear()
    except Runaway:
        raise  # opening the line again would allow new runs
    except HardwareError:
        return True
    return False


def explore_bench(
    folder: Path,
    *,
    port: str,
    observer: Observer,
    buttons: Buttons | None,
    goal: ErrorGoal,
    write_diary: Callable[..., object],
    seconds: float,
    vetoes: Callable[[Recording], bool] = lambda recording: False,
) -> tuple[Turn, ...]:
    """Explore the bench at a port; return the turns.

    Parameters
    ----------
    observer, buttons : see `acquire`. "skip" vetoes the chosen recording, before or during it;
        "stop" ends the exploration, even during a computation.
    goal, seconds, vetoes, write_diary : see `Exploration`.

    Raises
    ------
    Stopped : a signal or a button ended the exploration.
    HardwareError, ConfigError, DataError : see `acquire` and `Exploration`.
    """
    buttons = buttons or Buttons()

    def record(ids: Sequence[str]) -> Recorded:
        outcomes = acquire(folder, port=port, observer=observer, only=ids, buttons=buttons)
        if astray := [o.partial for o in outcomes if o.is_astray]:
            raise Runaway(f"{astray[-1]}; the exploration ends here")
        made = tuple(o.recording.id for o in outcomes if not o.partial)
        tried = [o.recording for o in outcomes if o.lines]
        skipped = any(o.wish == "skip" for o in outcomes)
        ends = dict.fromkeys(o.partial for o in outcomes if o.partial)
        return Recorded(
            ids=made,
            seconds=session_time(tried),
            vetoed=skipped and not made,
            why=". Then: ".join(ends),
        )

    def think(stage: str) -> None:
        if buttons.pressed == "stop":
            raise Stopped("by hand")
        observer.thinking(stage)

    if (folder / NAME).exists():
        ensure_plan(folder, port=port)
    exploration = Exploration(
        folder=folder,
        record=record,
        write_diary=write_diary,
        known_commands=known_commands,
        goal=goal,
        seconds=seconds,
        announce=lambda sentence: observer.thought(with_symbols(sentence)),
        progress=think,
        vetoes=vetoes,
    )
    return exploration.run()
