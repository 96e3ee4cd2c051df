"""Find the springs of a new submission from its steps, and check those that one states.

Beyond cart 1, all springs carry the same static force. So the static gains give ratios of
stiffnesses: k_(n+1) / k_n = K_(n-1) / K_n - 1. Without a spring at the far wall all carts move
equally, and only the spring wall-1 can hold them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.errors import DataError, SubmissionError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.estimation.estimates import SIGMA_LIMIT
from pipeline.estimation.static_gain import fit_static_gain
from pipeline.identify.groups import find_setups, steps_disagree
from pipeline.identify.model_checks import NEGLIGIBLE, check_vanishing
from pipeline.ingest.fill import (
    UNSURE,
    Found,
    fill_submission,
    heading_doubts,
    mark_system,
    system_doubts,
    unit_doubt,
)
from pipeline.ingest.read import read_data
from pipeline.names import toml_flags
from pipeline.results import (
    EXPLAINED,
    ChainFit,
    Check,
    Finding,
    FrequencyResponse,
    Record,
    StepGain,
)
from pipeline.setup import Setup
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME, spring_names
from pipeline.words.numbers import listing, significant

# On a bench, a spring is at least a tenth as stiff as the one before it.
_NO_SPRING = 0.1


@dataclass(frozen=True, kw_only=True)
class Filled:
    """The results of `fill`: the files, and the open questions on the set-up."""

    files: tuple[Found, ...]
    doubts: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Springs:
    """The springs present, the reason, and the numbers (from 1) of uncertain springs."""

    present: tuple[bool, ...]
    why: str
    open: tuple[int, ...]

    @property
    def is_certain(self) -> bool:
        """Whether at least one of the walls is decided."""
        return len(self.open) < 2


@dataclass(frozen=True, kw_only=True)
class _BetterSprings:
    """Springs that explain the frequency response much better than those stated.

    Attributes
    ----------
    before, after : χ² per degree of freedom with the stated springs and with these. `before` is
        None if no carts with the stated springs fit.
    """

    springs: tuple[bool, ...]
    before: float | None
    after: float


def fill_folder(folder: Path) -> Filled:
    """Write the tables of the files in `data/`, and the springs if `submission.toml` is new.

    Raises
    ------
    ConfigError, SubmissionError : as in `fill_submission`.
    """
    new = not (folder / NAME).exists()
    files = fill_submission(folder)
    submission = load_submission(folder)
    fractions = [found.file for found in files if found.has_fractions]
    doubt = unit_doubt(submission.system.position.unit, fractions=fractions)
    own = {"position": doubt} if doubt else {}
    if new:
        _state_springs(submission)
        own = heading_doubts(files) | own
        for key, why in own.items():
            mark_system(folder, key, doubt=UNSURE + why)
    doubts = own | system_doubts(folder)
    return Filled(files=files, doubts=tuple(f"{key}: {one}" for key, one in doubts.items()))


def find_springs(submission: Submission) -> Springs:
    """Return the springs of a submission from its steps, if these can be read."""
    steps = tuple(one for one in submission.experiments if one.kind == "step")
    try:
        records = read_data(submission.model_copy(update={"experiments": steps})).records
    except SubmissionError:  # no file exists, or no file can be read
        records = ()
    n = submission.system.carts
    found = decide_springs(records, n=n)
    driven = [record for record in records if len(record.free) == len(record.carts) == n]
    if n > 1 and found.is_certain and steps_disagree(driven):
        groups = find_setups(driven, bench=replace(submission.system.bench, springs=found.present))
        if groups:
            why = f"{found.why}, but steps of {len(groups)} set-ups contradict each other"
            return replace(found, why=why, open=(1, n + 1))
    return found


def _state_springs(submission: Submission) -> None:
    found = find_springs(submission)
    names = spring_names(submission.system.carts)
    if found.open:
        which = " or ".join(names[i - 1] for i in found.open)
        comment = f"{UNSURE}is there a spring {which}? {found.why} ({', '.join(names)})"
    else:
        comment = f"{', '.join(names)}: {found.why}"
    mark_system(submission.folder, "springs", doubt=comment, value=list(found.present))


def decide_springs(records: Sequence[Record], *, n: int) -> Springs:
    """Decide from steps which carts have a spring to a wall; springs between carts are assumed.

    Only steps with all carts free and measured are used.
    """
    every = (True,) * (n + 1)
    steps = [r for r in records if r.kind == "step" and len(r.free) == len(r.carts) == n]
    if not steps:
        return Springs(present=every, why="there is no step with all carts free", open=(1, n + 1))
    if all(map(_stays_away, steps)):
        inside = (False, *every[1:-1], False)
        return Springs(present=inside, why="no cart comes back after a step", open=())
    gains = [_gains(step) for step in steps]
    present, uncertain = every, (1, n + 1)
    if not any(gains):
        why = "no cart settles after a step"
    elif n == 1:
        uncertain = ()
        why = "the cart stays displaced under a step; only the sum of the springs can be known"
    else:
        low, high = np.median([_ratio(*one[-2:]) for one in gains if one], axis=0)
        why = "static gains are too uncertain"
        if low > NEGLIGIBLE:
            why, uncertain = "static gains do not show it", (1,)
        elif high < _NO_SPRING:
            why = "static gains are equal, so no spring ties the last cart to the wall"
            present, uncertain = (*every[:-1], False), ()
    return Springs(present=present, why=why, open=uncertain)


def check_springs(
    fit: ChainFit | None,
    *,
    responses: Sequence[FrequencyResponse],
    gains: Sequence[StepGain],
    records: Sequence[Record],
    bench: Setup,
) -> list[Check]:
    """Return a failed check for each stated or missing spring that the data contradict.

    The static gains show the last spring without any fit. If no carts with the stated springs
    explain the data, a fit with all springs shows which are missing. If that fit fails too, carts
    that come to rest after a step still need a spring to a wall.
    """
    n, stated = bench.n, bench.springs
    last = _last_by_gains(gains, bench=bench)
    better = _better_springs(fit, responses, bench=bench)
    right = better.springs if better else stated
    if last and right[-1] is stated[-1]:
        right = (*right[:-1], not right[-1])
    names, wrong = spring_names(n), [j for j in range(n + 1) if right[j] is not stated[j]]
    findings = []
    for j in wrong[:1] if n == 1 else wrong:  # of one cart, only the sum of the springs is known
        if better and better.springs[j] is not stated[j]:
            code = "better_springs" if better.before is not None else "better_springs_alone"
            # χ² per degree of freedom that the stated springs exceed by far.
            value, limit = better.before, max(better.after, EXPLAINED)
        else:
            assert last is not None
            code, value, limit = "no_spring" if stated[j] else "spring", last, _NO_SPRING
        details = {
            "spring": names[j],
            "named": _named(right, bench=bench),
            "before": f"K_{n - 1}",
            "last": f"K_{n}",
            "n": n,
            "value": significant(value or 0.0, digits=3),
            "percent": f"{100 * (value or 0.0):.0f}",
            "after": significant(better.after if better else 0.0, digits=3),
            "springs": toml_flags(right),
        }
        findings.append(
            Finding(
                code=code,
                kind="springs",
                parameter=f"k_{j + 1}",
                details=details,
                value=value,
                limit=limit,
            )
        )
    if not (findings or bench.tied or (fit and fit.converged)):
        by_steps = decide_springs(records, n=n)
        if by_steps.is_certain and (by_steps.present[0] or by_steps.present[-1]):
            details, parameter = {"last": names[-1]}, f"k_{n + 1}"
            tied = Finding(code="tied", kind="springs", parameter=parameter, details=details)
            findings.append(tied)
    return [finding.check for finding in findings]


def _named(right: Sequence[bool], *, bench: Setup) -> str:
    """Return the change from the stated springs to the right ones, in words."""
    if bench.n == 1:
        return "a spring"
    pairs = list(zip(spring_names(bench.n), right, bench.springs, strict=True))
    more = [name for name, is_there, stated in pairs if is_there and not stated]
    fewer = [name for name, is_there, stated in pairs if stated and not is_there]
    said = f"{'a spring' if len(more) == 1 else 'springs'} {listing(more)}"
    return f"{said} but no spring {listing(fewer)}" if fewer else said


def _last_by_gains(gains: Sequence[StepGain], *, bench: Setup) -> float | None:
    """Return k_(n+1) / k_n by the steps if it contradicts the last stated spring, or else None."""
    n = bench.n
    by_run = {(gain.experiment, gain.cart): gain for gain in gains}
    ratios = [
        _ratio(before, gain)
        for (run, cart), gain in by_run.items()
        if cart == n and (before := by_run.get((run, n - 1)))
    ]
    if not ratios:
        return None
    low, high = np.median(ratios, axis=0)
    stated = bench.springs[-1]
    if low <= _NO_SPRING < high or bool(high <= _NO_SPRING) is not stated:
        return None
    if stated and low < -_NO_SPRING:
        return None
    return float((low + high) / 2)


def _better_springs(
    fit: ChainFit | None, responses: Sequence[FrequencyResponse], *, bench: Setup
) -> _BetterSprings | None:
    """Return springs with which the carts explain the frequency response much better."""
    n, stated = bench.n, bench.springs
    if all(stated) or (n == 1 and any(stated)) or not responses:
        return None
    if fit and fit.converged and fit.explains_data:
        return None
    every = replace(bench, springs=(True,) * (n + 1))
    try:
        other = fit_bode(responses, bench=every)
    except DataError:
        return None
    before = _misfit(fit, responses, bench=bench)
    # A missing spring leaves a χ² that is a hundred times larger. Friction or a stiffening spring
    # is not explained by another linear spring.
    if not other.converged or (before and other.chi_square_per_dof > before / 100.0):
        return None
    k, std, largest = other.chain.k, other.std, float(np.max(other.chain.k))
    found = [
        bool(k[j] > _NO_SPRING * largest and k[j] > SIGMA_LIMIT * std.get(f"k_{j + 1}", np.inf))
        for j in range(n + 1)
    ]
    if n == 1:
        found = [found[0], found[0]]
    if not any(there and not was for there, was in zip(found, stated, strict=True)):
        return None
    gone = {check.parameter for check in check_vanishing(other, bench=every)}
    springs = tuple(
        there or (was and f"k_{j}" not in gone)
        for j, (there, was) in enumerate(zip(found, stated, strict=True), start=1)
    )
    return _BetterSprings(springs=springs, before=before, after=other.chi_square_per_dof)


def _misfit(
    fit: ChainFit | None, responses: Sequence[FrequencyResponse], *, bench: Setup
) -> float | None:
    """Return χ² per degree of freedom with the stated springs; None if no such carts fit."""
    if fit and fit.method == "bode_fit":
        return fit.chi_square_per_dof
    try:
        return fit_bode(responses, bench=bench, near=fit and fit.chain).chi_square_per_dof
    except DataError:
        return None


def _stays_away(step: Record) -> bool:
    """Whether the carts end a step far from their start, although the input is the same again."""
    u, moved = step.u, np.ptp(step.y, axis=1)
    if u is None or not np.all(moved > 0) or abs(u[-1] - u[0]) > 0.02 * np.ptp(u):
        return False
    # Friction keeps a cart away from its rest by far less than half of its motion.
    return bool(np.all(np.abs(step.y[:, -1] - step.y[:, 0]) > 0.5 * moved))


def _gains(step: Record) -> list[StepGain]:
    """Return the static gains of all carts, or [] if a cart does not settle."""
    try:
        return [fit_static_gain(step, cart=cart) for cart in sorted(step.carts)]
    except DataError:
        return []


def _ratio(before: StepGain, last: StepGain) -> tuple[float, float]:
    """Return the smallest and largest ratio of the last two springs that the steps allow."""
    (near, far), (low, high) = _bounds(before), _bounds(last)
    return near / high - 1, far / low - 1 if low > 0 else np.inf


def _bounds(gain: StepGain) -> tuple[float, float]:
    """Return the smallest and the largest absolute static gain that a step allows."""
    slack = SIGMA_LIMIT * gain.gain_std
    ends = gain.interval or (gain.gain - slack, gain.gain + slack)
    low, high = sorted(abs(end) for end in ends)
    return low, high
