"""The goal of further experiments: which errors to reach, measured by a single number."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError, DataError
from pipeline.experiments.information import FisherInformation
from pipeline.names import names_beginning
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import LoopSetup, simulate_loop
from pipeline.results import FeedbackDesign
from pipeline.submission.toml import nearest

GAP = "gap"  # the goal of distinguishing the explanations of a gap
DESIGN, WORST, MEAN, VOLUME = "design", "worst", "mean", "volume"
_STEP = 1e-4  # relative change of a parameter for a numerical derivative


@dataclass(frozen=True, kw_only=True, eq=False)
class Goal:
    """The error to reduce: of one number, or the largest or mean error of several numbers.

    Attributes
    ----------
    name : the goal's name, as given to `--for`.
    words : the error in words, such as "the error of zeta_2".
    rows : (k, n_p) derivatives of the numbers with respect to relative changes of the parameters.
        An overshoot is a share of the step. With one row, the design is c-optimal.
    mean : how several errors become one number. The "largest" gives an E-optimal design in the
        named parameters, the "root mean square" an A-optimal design, and the "volume" of the
        confidence region (as its mean radius) a D-optimal design.
    """

    name: str
    words: str
    rows: Array
    mean: Literal["largest", "root mean square", "volume"] = "largest"

    def of(self, information: Array) -> Array:
        """Return the error (…,) for the matrices H and S (…, 2, n_p, n_p); inf if unbounded."""
        H, S = information[..., 0, :, :], information[..., 1, :, :]
        if self.mean == "volume":
            (sign, of_h), (_, of_s) = np.linalg.slogdet(H), np.linalg.slogdet(S)
            log = np.where(sign > 0, of_s - 2 * of_h, np.inf)
            return np.exp(log / (2 * H.shape[-1]))
        variance = self._variances(H, S)
        squares = variance.mean(-1) if self.mean == "root mean square" else variance.max(-1)
        return np.sqrt(squares)

    def _variances(self, H: Array, S: Array) -> Array:
        try:
            half = self.rows @ np.linalg.inv(H)
        except np.linalg.LinAlgError:
            return np.full((*H.shape[:-2], len(self.rows)), np.inf)
        return np.einsum("...kp,...pq,...kq->...k", half, S, half)

    def worst(self, information: Array) -> int:
        """Return the index of the row with the largest error."""
        return int(np.argmax(self._variances(*information)))


def check_goal(name: str, *, names: Sequence[str]) -> None:
    """Refuse a goal that does not exist for carts with these parameters.

    Raises
    ------
    ConfigError : there is no such goal.
    """
    goals = [*names, DESIGN, WORST, MEAN, VOLUME]
    if name not in goals:
        raise ConfigError(f"--for {name}: there is no such parameter or goal{nearest(name, goals)}")


def find_goal(name: str, known: FisherInformation, *, feedback: FeedbackDesign | None) -> Goal:
    """Return the goal with this name: a parameter, "design", "worst", "mean" or "volume".

    Raises
    ------
    ConfigError : there is no such goal.
    DataError : the goal is "design", but no feedback was designed.
    """
    values, rows = known.chain.parameters(), known.by_parameters()
    check_goal(name, names=[*values])
    if name == WORST:
        return Goal(name=name, words="the error of the least known parameter", rows=rows)
    if name == MEAN:
        return Goal(
            name=name, words="the mean error of all parameters", rows=rows, mean="root mean square"
        )
    if name == VOLUME:
        return Goal(
            name=name,
            words="the mean error of masses, damping coefficients and stiffnesses",
            rows=rows,
            mean="volume",
        )
    if name == DESIGN:
        if feedback is None:
            raise DataError("--for design: no controller is designed: add a [design] table first")
        row = _by_overshoot(known, feedback)
        return Goal(name=name, words="the error of the predicted overshoot", rows=row)
    at = list(values).index(name)
    return Goal(name=name, words=f"the error of {name}", rows=rows[at : at + 1])


def _by_overshoot(known: FisherInformation, feedback: FeedbackDesign) -> Array:
    """Return the derivatives (1, n_p) of the loop's peak with respect to the parameters.

    The parameters change by shares of their values, and the peak is a share of the step. The
    controller stays the same.
    """
    P, chain = known.parametrisation, known.chain
    controller = feedback.controller(chain)
    t = feedback.t

    def peak(chain: Chain) -> float:
        loop = simulate_loop(
            chain,
            controller,
            t=t,
            reference=np.full(t.size, feedback.reference),
            setup=LoopSetup(sample_time=feedback.sample_time),
        )
        return float(np.max(loop.x[feedback.cart - 1] * np.sign(feedback.reference)))

    value, columns = P.physical(chain), []
    for change in _STEP * known.size * np.eye(value.size):
        up, down = (peak(P.chain(value + sign * change)) for sign in (1, -1))
        columns.append((up - down) / (2 * _STEP * abs(feedback.reference)))
    return np.array([columns])


def choose(candidates: Array, information: Array, *, n: int, goal: Goal) -> tuple[int, ...]:
    """Return the indices of the `n` candidates that give the smallest error, the best first.

    `candidates` is (m, 2, n_p, n_p); one candidate may be chosen several times. First, candidates
    are added one by one. Then each one in turn is replaced by a better one, until no replacement
    helps (the exchange algorithm).

    Parameters
    ----------
    information : (2, n_p, n_p) the information in the present records.

    References
    ----------
    V. V. Fedorov, Theory of Optimal Experiments, 1972, chapter 3; A. C. Atkinson, A. N. Donev,
    R. D. Tobias, Optimum Experimental Designs, with SAS, 2007, chapter 12.
    """
    enough = 1 - 1e-6  # a smaller relative improvement is a rounding error
    chosen: list[int] = []
    total = information
    for _ in range(n):
        chosen.append(int(np.argmin(goal.of(total + candidates))))
        total = total + candidates[chosen[-1]]
    for _ in range(20):
        before = float(goal.of(total))
        for place, one in enumerate(chosen):
            others = total - candidates[one]
            left = goal.of(others + candidates)
            best = int(np.argmin(left))
            if left[best] < enough * left[one]:
                chosen[place], total = best, others + candidates[best]
        if float(goal.of(total)) >= enough * before:
            break
    alone = goal.of(information + candidates)
    return tuple(sorted(chosen, key=lambda one: (alone[one], one)))


@dataclass(frozen=True, kw_only=True)
class ErrorGoal:
    """The relative error to reach for all parameters with this name prefix; "" means all."""

    prefix: str = ""
    error: float = 0.01

    def missing(self, errors: dict[str, float | None]) -> dict[str, float]:
        """Return the errors that are still too large, by parameter; inf if unknown.

        Raises
        ------
        ConfigError : no parameter's name has the prefix.
        """
        meant = {name: errors[name] for name in names_beginning(errors, self.prefix)}
        if not meant:
            hint = nearest(self.prefix, list(errors))
            raise ConfigError(f'--until "{self.prefix} …": there is no such parameter{hint}')
        return {
            name: np.inf if error is None else error
            for name, error in meant.items()
            if error is None or error > self.error
        }


def read_error_goal(text: str) -> ErrorGoal:
    """Read a goal such as "zeta 1%", "1 %" or "omega_1 0.05 %".

    Raises
    ------
    ConfigError : the text does not have this form.
    """
    before, _, after = text.partition("%")
    *name, share = before.split() or [""]
    try:
        error = float(share) / 100
    except ValueError:
        error = 0.0
    if not 0 < error < 1 or "%" not in text or after.strip() or len(name) > 1:
        raise ConfigError(f'--until "{text}": expected a name and a percentage, as "zeta 1%"')
    return ErrorGoal(prefix=name[0] if name and name[0] != "all" else "", error=error)


def read_time(text: str) -> float:
    """Read a time such as "20min", "90 s" or "1.5h"; return seconds.

    Raises
    ------
    ConfigError : the text does not have this form.
    """
    number = text.strip().rstrip("minsech ")
    unit = text.strip()[len(number) :].strip()
    seconds = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}.get(unit)
    try:
        if seconds is not None and 0 < seconds * float(number) < np.inf:
            return seconds * float(number)
    except ValueError:
        pass
    raise ConfigError(f'--time "{text}": expected a duration, as "20min" or "90s"')
