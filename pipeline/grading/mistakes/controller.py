"""Diagnose the reported controller: gains, claims and prefilter.

Reported gains are simulated on a chain of carts: stability, overshoot, settling time, static gain.
A right prefilter is the reciprocal of the loop's static gain.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.state_feedback import (
    MASS_SPRING_ERROR,
    level_error_percent,
    static_levels,
)
from pipeline.grading import limits
from pipeline.grading.grade import Flag
from pipeline.grading.mistakes.state_model import Order, own_chain
from pipeline.grading.reference import is_explained
from pipeline.grading.tolerance import as_typed, rounding
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.plant import simulate
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import discretise
from pipeline.results import Analysis
from pipeline.submission import Design, StateFeedbackController, Submission
from pipeline.workflow import reference_design

_SAMPLE_TIME = 0.00884  # s; that of the ECP controller, for a design that states none
_HORIZON = 6.0  # simulated time, as a multiple of the required settling time
_MOST_SAMPLES = 60_000
_BLOWN_UP = 1e6  # a response this many times the reference counts as diverged


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopNumbers:
    """Results of a simulation of the sampled closed loop.

    The controller compensates for its delay of one sample by predicting the state.

    Attributes
    ----------
    poles : poles of the equivalent continuous loop, in rad/s.
    overshoot : overshoot in percent; infinite if the loop is unstable.
    settling_time : settling time in s; None if the loop does not settle in the simulated time.
    prefilter : reciprocal of the loop's static gain, so that the cart settles at the reference.
    """

    stable: bool
    poles: ComplexArray
    overshoot: float
    settling_time: float | None
    prefilter: float


def loop_numbers(
    chain: Chain, gains: Array, *, cart: int, settling: float, sample_time: float | None
) -> LoopNumbers | None:
    """Simulate the loop with gains (2n,) on a chain; return None if it cannot be computed."""
    T = sample_time or _SAMPLE_TIME
    row, size = 2 * (cart - 1), 2 * chain.n
    with np.errstate(all="ignore"):
        phi, gamma = discretise(chain, T)
        loop = phi - np.outer(gamma, gains)
        if not np.all(np.isfinite(loop)):
            return None
        z = np.linalg.eigvals(loop).astype(np.complex128)
        try:
            static = np.linalg.solve(np.eye(size) - loop, gamma)
        except np.linalg.LinAlgError:
            return None
        prefilter = float(1 / static[row])
        if not np.isfinite(prefilter):
            return None
        poles = np.asarray(np.log(z) / T, dtype=np.complex128)
        stable = bool(np.abs(z).max() < 1)
        samples = int(_HORIZON * settling / T) + 2
        # With a very short sample time, only every `stride`-th sample is computed.
        stride = math.ceil(samples / _MOST_SAMPLES)
        count = math.ceil(samples / stride)
        y = _step(*_together(loop, gamma / static[row], stride), row=row, count=count)
    overshoot, settles = np.inf, np.nan
    if stable and np.abs(y).max() < _BLOWN_UP:
        t = T * np.maximum(1.0 + stride * (np.arange(y.size) - 1.0), 0.0)
        judged = {"before": 0.0, "level": np.float64(1.0)}
        overshoot = float(simulate.overshoot_percent(y, **judged))
        settles = float(simulate.settling_time(t, y, **judged))
    return LoopNumbers(
        stable=stable,
        poles=poles,
        overshoot=overshoot,
        settling_time=None if np.isnan(settles) else settles,
        prefilter=prefilter,
    )


def _together(loop: Array, drive: Array, stride: int) -> tuple[Array, Array]:
    """Return the L and d with which x_{i+1} = L x_i + d advances by `stride` samples at once."""
    size = drive.size
    one = np.eye(size + 1)
    one[:size, :size], one[:size, size] = loop, drive
    several = np.linalg.matrix_power(one, stride)
    return several[:size, :size], several[:size, size]


def _step(loop: Array, drive: Array, *, row: int, count: int) -> Array:
    """Return the response to a unit step, shape (count,).

    Because of the delay, it begins with 0.
    """
    states = np.zeros((drive.size, 1))
    power, offset = loop, drive[:, None]
    # x_{k+1} = L x_k + d. Each pass doubles the number of known samples.
    while states.shape[1] < count:
        states = np.hstack([states, power @ states + offset])
        offset, power = offset + power @ offset, power @ power
    return np.concatenate([[0.0], states[row, : count - 1]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Controller:
    """The reported controller and the data for judging it.

    Attributes
    ----------
    gains : the reported gains, shape (2n,); None if not reported.
    ran : the gains that a closed-loop run states, shape (2n,); None if no run states any.
    models : the chains on which gains are simulated: from the recordings, and from the student's
        tables.
    goal : the design goal. If both the reference design and the reported gains miss it, this is the
        easier goal that the reference design reaches.
    blurred : whether friction makes the static gains from the recordings uncertain.
    own : whether the student's table is complete, so that their own model is known.
    reference : the chain from the recordings, which is also the first of the models; None if the
        carts were not identified.
    doubt : relative error of the prefilter that may come from errors of the models.
    """

    gains: Array | None
    prefilter: Decimal | None
    overshoot: Decimal | None
    settling: Decimal | None
    ran: Array | None
    models: tuple[Chain, ...]
    goal: Design
    blurred: bool
    own: bool
    reference: Chain | None
    doubt: float = 0.0

    def judged_from(self, source: str) -> "Controller":
        """Return the controller with only the models of one source: "own" or "recordings"."""
        n_first = 0 if self.reference is None else 1
        if source == "own":
            return replace(self, models=self.models[n_first:])
        return self if source == "either" else replace(self, models=self.models[:n_first])

    def numbers(self, gains: Array) -> list[LoopNumbers]:
        """Return the simulated loop with some gains, one for each model."""
        found = [self.on(chain, gains) for chain in self.models]
        return [numbers for numbers in found if numbers is not None]

    def runaway(self, gains: Array) -> LoopNumbers | None:
        """Return the loop simulated on the identified carts; None unless it is clearly unstable.

        Growth by less than a factor of e within the required settling time may be a model error.
        """
        numbers = self.on(self.reference, gains) if self.reference is not None else None
        if numbers is None or numbers.stable:
            return None
        fast = float(numbers.poles.real.max()) * self.goal.settling_time > 1
        return numbers if fast else None

    def on(self, chain: Chain, gains: Array, *, cart: int = 0) -> LoopNumbers | None:
        """Return the loop with some gains on a chain, for one cart; default: that of the goal."""
        return loop_numbers(
            chain,
            gains,
            cart=cart or self.goal.cart,
            settling=self.goal.settling_time,
            sample_time=self.goal.sample_time,
        )

    def reaches_goal(self, gains: Array) -> bool:
        """Return whether gains reach the goal on one of the models."""
        return any(
            self.meets(numbers, overshoot=0.0, settling=1.0) for numbers in self.numbers(gains)
        )

    def meets(
        self,
        numbers: LoopNumbers,
        *,
        overshoot: float = limits.OVERSHOOT,
        settling: float = limits.SETTLING,
    ) -> bool:
        """Return whether a loop meets the goal, apart from the given allowances.

        Parameters
        ----------
        overshoot : allowed overshoot above the goal, in percentage points.
        settling : allowed settling time, as a multiple of the goal's.
        """
        return (
            numbers.stable
            and numbers.overshoot <= self.goal.overshoot_percent + overshoot
            and numbers.settling_time is not None
            and numbers.settling_time <= settling * self.goal.settling_time
        )

    def is_claimed(self, numbers: LoopNumbers) -> bool:
        """Return whether a loop behaves about as the student claims."""
        if self.overshoot is not None and not (
            abs(numbers.overshoot - float(self.overshoot)) <= limits.CLAIM_OVERSHOOT
        ):
            return False
        if self.settling is None or self.settling <= 0:
            return True
        settles = numbers.settling_time
        ratio = None if settles is None else settles / float(self.settling)
        return ratio is not None and 1 / limits.CLAIM_SETTLING <= ratio <= limits.CLAIM_SETTLING

    def confirms(self, gains: Array | None) -> bool:
        """Return whether gains are those that ran; without a run, whether all numbers fit them."""
        if gains is None:
            return False
        if self.ran is not None:
            return same_gains(gains, self.ran)
        return any(
            self.meets(one) and self.prefilter_fits(one) and self.is_claimed(one)
            for one in self.numbers(gains)
        )

    def is_of_other_gains(self, numbers: LoopNumbers) -> bool:
        """Return whether the claimed settling time must belong to different gains.

        It must if it differs from the simulated one by more than a factor of 2.5.
        """
        if self.settling is None or self.settling <= 0 or numbers.settling_time is None:
            return False
        ratio = numbers.settling_time / float(self.settling)
        return max(ratio, 1 / ratio) > 2.5  # settling time does not depend on the prefilter

    def prefilter_fits(self, numbers: LoopNumbers, *, sharp: bool = False) -> bool:
        """Return whether the reported prefilter is the reciprocal of this loop's static gain.

        Parameters
        ----------
        sharp : whether to use the close tolerance even with friction.
        """
        if self.prefilter is None:
            return True
        off = abs(float(self.prefilter) - numbers.prefilter) - float(rounding(self.prefilter))
        allowed = limits.PREFILTER_BLURRED if self.blurred and not sharp else limits.PREFILTER
        return off <= (allowed + self.doubt) * abs(numbers.prefilter)


def reported_controller(
    submission: Submission,
    analysis: Analysis,
    *,
    chain: Chain | None,
    tables: Sequence[Mapping[str, float]],
    orders: Sequence[Order] = (),
) -> tuple[Controller | None, Order | None]:
    """Return the controller of a submission, and the order in which its gains are meant.

    The controller is None if it is missing or cannot be judged. The order is None if the gains are
    in the usual order (x1, v1, x2, v2 and so on). Another order needs evidence. Only in this order,
    the gains are those that ran, or they meet the goal and fit the other reported numbers.

    Parameters
    ----------
    chain : the chain from the recordings; None if the carts were not identified.
    tables : the student's final table: as typed, and with known mistakes corrected.
    orders : the orders of the states that the other reported numbers have.
    """
    feedback = submission.reported.feedback if submission.reported else None
    n = submission.system.carts
    own = [own_chain(values, n=n) for values in tables]
    models = [model for model in (chain, *own) if model is not None]
    if feedback is None or not models:
        return None, None
    ran = [
        e.controller.gains
        for e in submission.experiments
        if isinstance(e.controller, StateFeedbackController) and e.controller.gains
    ]
    controller = Controller(
        gains=np.array([float(g) for g in feedback.gains]) if feedback.gains else None,
        prefilter=feedback.prefilter,
        overshoot=feedback.overshoot_percent,
        settling=feedback.settling_time,
        ran=np.array(ran[0]) if ran else None,
        models=tuple(models),
        goal=submission.design or Design(cart=n),
        blurred=not is_explained(analysis),
        own=any(model is not None for model in own),
        reference=chain,
    )

    def judged(one: Controller) -> Controller:
        doubt = _doubt(one, submission, analysis)
        return replace(one, doubt=doubt, goal=_goal(one, submission, analysis))

    for one in orders:
        better = judged(_in_order(controller, one))
        if better.confirms(better.gains) and not better.confirms(controller.gains):
            return judged(better), one
    return judged(controller), None


def _in_order(controller: Controller, order: Order) -> Controller:
    """Return a controller whose gains are listed in an order of the states."""
    gains = controller.gains
    if gains is None or gains.size != len(order):
        return controller
    meant = np.empty_like(gains)
    meant[list(order)] = gains
    return replace(controller, gains=meant)


def _doubt(controller: Controller, submission: Submission, analysis: Analysis) -> float:
    """Return the relative error of the prefilter that may come from errors of the models.

    The models have errors from the fit or from the rounding of typed numbers. Gains that cancel
    much of the springs' stiffness amplify these errors.
    """
    chain, gains, cart = controller.models[0], controller.gains, controller.goal.cart
    if gains is None or gains.size != 2 * chain.n:
        return 0.0
    share = float(level_error_percent(chain, gains, cart=cart)) / 100 / MASS_SPRING_ERROR
    fitted = [
        limits.PREFILTER_SIGMAS * row.final.std / abs(row.final.value)
        for row in analysis.rows
        if read_name(row.name).is_gain and row.final and row.final.std and row.final.value
    ]
    typed = submission.reported.final if submission.reported else {}
    return max(share * max(fitted, default=0.0), _by_rounding(typed, gains, cart=cart))


def _by_rounding(typed: Mapping[str, Decimal], gains: Array, *, cart: int) -> float:
    """Return the relative change of the prefilter that the rounding of a typed table can cause."""
    values = {name: float(value) for name, value in typed.items()}

    def level(table: Mapping[str, float]) -> float:
        chain = own_chain(table, n=gains.size // 2)
        try:
            return np.nan if chain is None else float(static_levels(chain, gains)[cart - 1])
        except np.linalg.LinAlgError:  # the gains cancel all stiffness, so there is no static level
            return np.nan

    half = {name: float(rounding(value)) for name, value in typed.items()}
    moved = [level({**values, name: values[name] + half[name]}) for name in values]
    relative = np.nan_to_num(np.array(moved) / level(values) - 1)
    return limits.PREFILTER_SIGMAS / np.sqrt(3) * float(np.linalg.norm(relative))


def _goal(controller: Controller, submission: Submission, analysis: Analysis) -> Design:
    """Return the goal, or an easier one if neither the gains nor the reference design reach it.

    The easier goal is what the reference design reaches.
    """
    goal = controller.goal
    if controller.gains is None or controller.reaches_goal(controller.gains):
        return goal
    try:
        design = reference_design(submission, analysis.fit)
    except DataError:
        return goal
    if design.reachable or design.settling_time is None:
        return goal
    return goal.model_copy(
        update={
            "overshoot_percent": max(goal.overshoot_percent, design.overshoot_percent),
            "settling_time": max(goal.settling_time, design.settling_time),
        }
    )


# ------------------------------------------------------------------------- flags


def diagnose_controller(controller: Controller) -> tuple[list[Flag], Array | None]:
    """Return the flags of the gains and of the prefilter, and the gains that were meant.

    These are None if the reported gains are right, or if no known mistake explains them.

    A prefilter is not flagged if it fits the gains that the student probably meant.
    """
    if controller.gains is None:
        return [], None
    numbers = controller.numbers(controller.gains)
    if not numbers:
        return [], None
    flags = []
    fits = any(controller.prefilter_fits(one) for one in numbers)
    meets = any(controller.meets(one) for one in numbers)
    claimed = any(controller.is_claimed(one) for one in numbers)
    # Gains that meet the goal and match the claims are those that the student meant.
    is_stated = controller.overshoot is not None or controller.settling is not None
    slip, intended = ("", None) if meets and is_stated and claimed else _slip(controller)
    ran, meant = controller.ran, None
    # If the bench ran with other gains, they show which of the reported numbers is wrong.
    other_ran, better = ran is not None and not same_gains(ran, controller.gains), False
    sharply = any(controller.prefilter_fits(one, sharp=True) for one in numbers)
    wrong = not meets or (slip and not (fits and claimed)) or (not claimed and not sharply)
    wrong = wrong or all(controller.is_of_other_gains(one) for one in numbers)
    if other_ran and ran is not None:
        of_ran = controller.numbers(ran)
        better = any(
            controller.prefilter_fits(one) and controller.is_claimed(one) for one in of_ran
        )
        wrong = wrong or (better and not (fits and claimed))
    if wrong:
        flags.append(_gains_flag(controller, numbers[0], slip=slip, other_ran=other_ran))
        meant = intended if intended is not None else ran if better else None
        sources = [g for g in (intended, ran if other_ran else None) if g is not None]
        known = [one for gains in sources for one in controller.numbers(gains)]
        fits = fits or not known or any(controller.prefilter_fits(one) for one in known)
    if not fits and controller.prefilter is not None:
        slip = _prefilter_slip(controller, numbers[0].prefilter)
        # Without the student's own carts, a misfit may only be a difference between models.
        if controller.own or slip:
            flags.append(_prefilter_flag(controller, numbers[0], slip=slip))
    return flags, meant


def same_gains(a: Array, b: Array) -> bool:
    """Return whether two sets of gains are equal within 2 % of the largest gain of their kind.

    The two kinds are gains of positions and gains of velocities.
    """
    if a.shape != b.shape:
        return False
    scale = np.empty_like(a)
    for part in (0, 1):
        scale[part::2] = max(float(np.abs(a[part::2]).max()), float(np.abs(b[part::2]).max()))
    return bool(np.all(np.abs(a - b) <= 0.02 * np.maximum(scale, 1e-300)))


def _slip(controller: Controller) -> tuple[str, Array | None]:
    """Return the known mistake whose correction makes the gains right, and the corrected gains.

    Returns ("", None) if there is no such mistake.
    """
    gains = controller.gains
    assert gains is not None
    for text, meant in _undone(gains):
        if controller.confirms(meant):
            return text, meant
    return "", None


def _undone(gains: Array) -> Iterator[tuple[str, Array]]:
    """Yield each known mistake in words, with the gains that correct it.

    Mistakes whose correction changes nothing are left out.
    """
    n = gains.size // 2
    pairs = gains.reshape(n, 2)
    found = [(WORDS.text("all_signs"), -gains)]
    if n > 1:
        found.append((WORDS.text("gains_positions_first"), gains.reshape(2, n).T.ravel()))
        others = list(itertools.permutations(range(n)))[1:]
        found += [(WORDS.text("gains_of_others"), pairs[list(p)].ravel()) for p in others]
    found.append((WORDS.text("gains_exchanged"), pairs[:, ::-1].ravel()))
    for i, gain in enumerate(gains):
        flipped = gains.copy()
        flipped[i] = -gain
        found.append((WORDS.text("sign_of_gain", number=i + 1), flipped))
    for text, meant in found:
        if not same_gains(meant, gains):
            yield text, meant


def does(numbers: LoopNumbers) -> str:
    """Return the response of a loop in words: unstable, or its overshoot and settling time."""
    if not numbers.stable:
        return WORDS.text("unstable")
    seconds = numbers.settling_time
    return WORDS.text(
        "does",
        overshoot=f"{round(numbers.overshoot, 2):.3g}",
        settling=WORDS.text("settles", seconds=f"{seconds:.3g}")
        if seconds is not None
        else WORDS.text("never_settles"),
    )


def _gains_flag(
    controller: Controller, numbers: LoopNumbers, *, slip: str, other_ran: bool
) -> Flag:
    goal = controller.goal
    why = slip or (
        WORDS.text("not_those_that_ran")
        if other_ran
        else WORDS.text("settling_reported", settling=controller.settling)
        if controller.meets(numbers)
        else WORDS.text(
            "goal", overshoot=f"{goal.overshoot_percent:g}", settling=f"{goal.settling_time:g}"
        )
    )
    assert controller.gains is not None
    return Flag(
        code="wrong_gains",
        parameters=("gains",),
        message=WORDS.text("gains", does=does(numbers), why=why),
        evidence={
            "reported": controller.gains.tolist(),
            "ran": None if controller.ran is None else controller.ran.tolist(),
            "stable": numbers.stable,
            "overshoot_percent": numbers.overshoot if np.isfinite(numbers.overshoot) else None,
            "settling_time": numbers.settling_time,
            "slip": slip,
        },
    )


def _prefilter_slip(controller: Controller, right: float) -> str:
    """Return the known mistake that gives the reported prefilter, in words, or ""."""
    typed = controller.prefilter
    assert typed is not None
    for text, value in _prefilter_slips(controller, right):
        room = 0.5 * limits.PREFILTER * abs(value) + float(rounding(typed))
        if abs(float(typed) - value) <= room:
            return text
    return ""


def _prefilter_flag(controller: Controller, numbers: LoopNumbers, *, slip: str) -> Flag:
    typed, right = controller.prefilter, numbers.prefilter
    assert typed is not None
    return Flag(
        code="wrong_prefilter",
        parameters=("prefilter",),
        message=WORDS.text(
            "prefilter",
            recomputed=f"{right:.4g}",
            reported=as_typed(typed),
            why=slip or WORDS.text("prefilter_is"),
        ),
        evidence={
            "parameter": "prefilter",
            "reported": float(typed),
            "recomputed": right,
            "ratio": float(typed) / right if right else None,
        },
    )


def _prefilter_slips(controller: Controller, right: float) -> Iterator[tuple[str, float]]:
    chain, goal = controller.models[0], controller.goal
    yield WORDS.text("prefilter_reciprocal"), 1 / right
    yield WORDS.text("prefilter_sign"), -right
    if chain.is_tied:
        yield WORDS.text("prefilter_open"), 1 / float(chain.static_gains()[goal.cart - 1])
    for cart in range(1, chain.n + 1):
        if cart != goal.cart and controller.gains is not None:
            other = controller.on(chain, controller.gains, cart=cart)
            if other is not None:
                sentence = WORDS.text("prefilter_of_other", cart=cart, goal=goal.cart)
                yield sentence, other.prefilter
    if right != 1.0:
        yield WORDS.text("prefilter_none"), 1.0
