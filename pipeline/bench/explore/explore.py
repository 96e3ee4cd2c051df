"""Record, identify, look for the gap, choose, record: until it is known, or time is up."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.bench.design.discriminate import propose_for
from pipeline.bench.design.next_plan import choose_next, known_commands
from pipeline.bench.planning.plan import Plan, Recording
from pipeline.bench.planning.plan_file import load_plan, plan_path, save_plan
from pipeline.bench.planning.plan_words import session_time, time_words
from pipeline.bench.planning.propose import (
    identified_chain,
    large_steps,
    propose_plan,
    renamed,
)
from pipeline.errors import ConfigError, DataError
from pipeline.estimation.chain.parametrisation import named_estimates
from pipeline.gap.investigate import investigate
from pipeline.gap.stored import gap_text
from pipeline.gap.types import Gap
from pipeline.names import listed
from pipeline.output import own_folder, write_file
from pipeline.report.exploration.page import write_diary
from pipeline.report.exploration.turn import Explanation, Turn
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.submission.load import NAME
from pipeline.workflow import analyse

FIRST = "sweep"  # of the plan that is proposed where nothing is known: it needs no hands
_SEARCH = 90.0  # s that a look for the gap may take
_APART = 1.0  # noises: explanations that no recording sets further apart stay in dispute
_FAR = 0.5  # of the travel limit: who has not moved so far has not shown all
_FAR_OUT = "to see what acts far out"
_SETTLED = ("named", "none")

Record = Callable[[Sequence[str]], Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class Wish:
    """How well what is to be known: every parameter whose name begins so; "": all of them."""

    prefix: str = ""
    error: float = 0.01

    def missing(self, errors: dict[str, float | None]) -> dict[str, float]:
        """Return the parameters that are not known so well yet, with their errors."""
        meant = {name: e for name, e in errors.items() if name.startswith(self.prefix)}
        return {
            name: np.inf if error is None else error
            for name, error in meant.items()
            if error is None or error > self.error
        }


def read_wish(text: str) -> Wish:
    """Read "zeta 1%", "1 %" or "omega_1 0.05 %".

    Raises
    ------
    ConfigError : it is none of these.
    """
    *name, share = text.replace("%", " % ").split("%")[0].split() or [""]
    try:
        error = float(share) / 100
    except ValueError:
        error = 0.0
    if not 0 < error < 1 or "%" not in text or len(name) > 1:
        raise ConfigError(f'--until "{text}": expected a name and a percentage, as "zeta 1%"')
    return Wish(prefix=name[0] if name and name[0] != "all" else "", error=error)


def read_time(text: str) -> float:
    """Read "20min", "90 s" or "1.5h"; return seconds.

    Raises
    ------
    ConfigError : it is none of these.
    """
    number = text.strip().rstrip("minsech ")
    unit = text.strip()[len(number) :].strip()
    seconds = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}.get(unit)
    try:
        if seconds is not None and float(number) > 0:
            return seconds * float(number)
    except ValueError:
        pass
    raise ConfigError(f'--time "{text}": expected a duration, as "20min" or "90s"')


def explore(
    folder: Path, *, record: Record, wish: Wish, seconds: float, tell: Callable[[str], None]
) -> tuple[Turn, ...]:
    """Explore the bench behind `record` into a submission; return what was known turn by turn.

    The submission, gap/gap.json and the diary stand there after each turn, so whatever ends it
    leaves them as they were.

    Parameters
    ----------
    record : carries out recordings of the plan by their ids and returns those that came off; the
        first call makes submission and plan where there are none.
    seconds : at the bench, rests included; no recording is begun that would go beyond.
    tell : takes a sentence at each turn.

    Raises
    ------
    DataError : the first recordings do not identify the carts.
    """
    known = (folder / NAME).exists() and bool(load_submission(folder).experiments)
    made = () if known else tuple(record([FIRST]))
    submission = load_submission(folder)
    if not plan_path(submission).exists():
        save_plan(propose_plan(submission), submission)
    plan = load_plan(submission)
    if not known:
        steps = [r.id for r in plan.recordings if r.kind == "step" and not r.release]
        made += tuple(record(steps)) if steps else ()
    spent = session_time([r for r in plan.recordings if r.id in made])
    turns: list[Turn] = []
    refused: set[str] = set()
    while True:
        analysis, gap = _look(folder, tell)
        plan = load_plan(load_submission(folder))
        turn, recording = _decide(analysis, gap, plan, folder, wish=wish, refused=refused)
        if recording and spent + session_time([recording]) > seconds:
            left = f"the {time_words(seconds)} allowed are up before {recording.id} would be done"
            turn, recording = replace(turn, said=f"{turn.said}, but {left}"), None
        turn = replace(turn, seconds=spent, recorded=made)
        turns.append(turn)
        write_diary(turns, analysis, folder, wanted=wish.error)
        tell(turn.said)
        if recording is None:
            return tuple(turns)
        made = tuple(record([recording.id]))
        spent += session_time([recording])
        if not made:  # a limit, or somebody at the bench who did not want it
            refused.add(_shape(recording))


def _look(folder: Path, tell: Callable[[str], None]) -> tuple[Analysis, Gap]:
    """Identify the carts and look for the gap; both are of the data as they stand now."""
    submission = load_submission(folder)
    analysis = analyse(submission)
    gap = investigate(analysis, progress=lambda text: None, budget=_SEARCH)
    gap = propose_for(gap, submission)
    place = own_folder(folder, "gap")
    place.mkdir(exist_ok=True)
    write_file(place / "gap.json", gap_text(gap, analysis))
    return _with_effects(analysis, gap), gap


def _with_effects(analysis: Analysis, gap: Gap) -> Analysis:
    """Return the analysis with the carts as they are beside the effects that act on them.

    Raises
    ------
    DataError : neither with effects nor without them the carts are identified.
    """
    fit, model, covariance = analysis.fit, gap.model, gap.chain_covariance
    if fit is None or not (fit.converged or model.terms):
        reasons = "; ".join(one.reason for one in analysis.skipped if "estimates" in one.stage)
        raise DataError(f"the carts are not identified: {reasons or 'see the report'}")
    if not model.terms or covariance is None or not model.chain.is_tied:
        return analysis
    names = tuple(gap.chain_std)
    # What the linear chain leaves is no noise: the encoders' own is.
    noise = {name: np.ones_like(left) for name, left in fit.standardised.items()}
    parameters = named_estimates(model.chain, names=names, covariance=covariance, source="gap")
    fit = replace(
        fit,
        chain=model.chain,
        names=names,
        covariance=covariance,
        parameters=parameters,
        standardised=noise,
        converged=True,
    )
    return replace(analysis, fit=fit)


def _decide(
    analysis: Analysis, gap: Gap, plan: Plan, folder: Path, *, wish: Wish, refused: set[str]
) -> tuple[Turn, Recording | None]:
    """Return the turn, and the recording to make next: it stands in the plan."""
    errors = _errors(analysis)
    missing = wish.missing(errors)
    known = _known_words(missing, errors)
    doubt = _doubt_words(gap)
    recording, why = None, ""
    try:
        recording, why = _next(analysis, gap, plan, folder, missing=missing)
    except DataError as error:
        why = str(error)
    if recording and _shape(recording) in refused:
        recording, why = None, f"{recording.id} was refused before, and nothing else tells as much"
    if recording:
        taken = [r.id for r in plan.recordings] + [record.id for record in analysis.records]
        (recording,) = renamed([recording], taken=taken)
        longer = plan.model_copy(update={"recordings": (*plan.recordings, recording)})
        save_plan(longer, load_submission(folder))
        why = f"therefore {recording.id}: {why}"
    said = "; ".join(filter(None, [known, doubt, why or "so this is the end"]))
    return (
        Turn(
            seconds=0.0,
            recorded=(),
            errors=errors,
            verdict=gap.verdict,
            explanations=_explanations(gap),
            left=gap.final,
            floor=gap.noise_floor,
            said=said,
        ),
        recording,
    )


def _next(
    analysis: Analysis,
    gap: Gap,
    plan: Plan,
    folder: Path,
    *,
    missing: dict[str, float],
) -> tuple[Recording | None, str]:
    """Return what to record next and why; None where all is known, or nothing would help."""
    settled, commands = gap.verdict in _SETTLED, known_commands(folder)
    if gap.proposal is not None and gap.proposal.separation > _APART:
        recording = Recording.model_validate_json(json.dumps(gap.proposal.recording))
        return recording, (
            f"in it the explanations differ by {gap.proposal.separation:.2g} times the noise"
        )
    if missing and settled:
        worst = max(missing, key=lambda name: missing[name])
        found = choose_next(analysis, plan, n=1, goal=worst, commands=commands)
        return found.recordings[0], found.said
    furthest = max(float(np.ptp(record.y, axis=1).max()) / 2 for record in analysis.records)
    # Once: carts that something holds back go no further the second time.
    made = any(r.note == _FAR_OUT for r in plan.recordings)
    if furthest < _FAR * plan.limits.travel and not made:
        step, _ = large_steps(identified_chain(analysis), plan.limits)
        return step.model_copy(update={"note": _FAR_OUT}), (
            f"no cart has moved by more than {furthest:.2g} of {plan.limits.travel:g} "
            f"{analysis.position_unit} allowed, and what acts further out would not show"
        )
    return None, "" if settled else "no recording within the limits would decide"


def _shape(recording: Recording) -> str:
    """Return what a recording is, whatever it is called."""
    return recording.model_copy(update={"id": "", "note": "", "aim": ""}).model_dump_json()


# ------------------------------------------------------------------------------ in words


def _errors(analysis: Analysis) -> dict[str, float | None]:
    """Return the relative standard error of each parameter."""
    assert analysis.fit is not None
    return {
        name: None if e.std is None or not e.value else float(e.std / abs(e.value))
        for name, e in analysis.fit.parameters.items()
    }


def _known_words(missing: dict[str, float], errors: dict[str, float | None]) -> str:
    if not missing:
        worst = max((error for error in errors.values() if error is not None), default=0.0)
        return f"every parameter asked for is known, the worst of all to ± {100 * worst:.2g} %"
    name = max(missing, key=lambda one: missing[one])
    if not np.isfinite(missing[name]):
        return f"{name} is not known at all"
    return f"{name} is known to ± {100 * missing[name]:.2g} % only"


def _doubt_words(gap: Gap) -> str:
    named = listed([_name(found.effect.title, found.where) for found in gap.effects])
    times = f"{gap.final / gap.noise_floor:.2g} times the noise" if gap.noise_floor else "a gap"
    match gap.verdict:
        case "none":
            return "the linear carts explain the motion down to the noise"
        case "named":
            return f"what else acts has a name: {named}"
        case "partial":
            return f"{named} is only part of the gap, {times} is left"
        case "ambiguous":
            rivals = " or ".join(one.name for one in _explanations(gap)[:2])
            return f"it may be {rivals}"
    return f"{times} is left and has no name"


def _explanations(gap: Gap) -> tuple[Explanation, ...]:
    contenders = [(one.model.terms, one.weight) for one in gap.contenders]
    if gap.verdict == "named":
        contenders = [(gap.model.terms, 1.0)]
    return tuple(
        Explanation(
            name=" and ".join(_name(term.effect.title, term.where) for term in terms)
            or "the linear chain",
            weight=weight,
        )
        for terms, weight in contenders
    )


def _name(title: str, where: dict[str, int]) -> str:
    place = " ".join(f"{key} {value}" for key, value in where.items())
    return f"{title.lower()} on {place}" if place else title.lower()
