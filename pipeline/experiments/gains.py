"""The controller of a recording, in the units that the bench uses, checked for safety.

The bench computes in duty counts and encoder counts, once per period, by the laws in
`plant.sampled_loop`. State feedback assumes constant velocity between samples and one period
of delay; PID has no delay. A design may assume a different sample time and predict with a model. So
the loop is simulated as the bench will run it, before any gain is sent.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.state_feedback import stays_stable
from pipeline.experiments.plan import PidLoop, PlanLimits, Recording, StateLoop
from pipeline.identify.recording_checks import is_reversed
from pipeline.plant import sampled_loop, simulate
from pipeline.plant.chain import Chain
from pipeline.protocol import FULL_SCALE, Description, PidGains, StateGains
from pipeline.results import Analysis, FeedbackDesign
from pipeline.submission import Design, Submission

Table: TypeAlias = dict[str, Any]

_PID_SHARES = (1.0, 0.5, 0.25, 0.1)  # shares of the carts' own stiffness that a proposed kp adds


@dataclass(frozen=True, kw_only=True)
class CountScales:
    """How much one count is worth in the submission's units.

    Attributes
    ----------
    input : input units per duty count. Negative if a positive duty drives cart 1 to negative x.
    position : position units per encoder count.
    """

    input: float
    position: float


def bench_scales(submission: Submission, *, bench: Description, analysis: Analysis) -> CountScales:
    """Return the scales stated by the submission or, if missing, by the bench.

    The sign of the input is the one found in the data.

    Raises
    ------
    DataError : neither the submission nor the bench states a scale in the submission's unit.
    """
    stated = submission.system
    for key, scale, unit in (
        ("input", stated.input, bench.input_unit),
        ("position", stated.position, bench.position_unit),
    ):
        if scale.per_count is None and scale.unit != unit:
            raise DataError(
                f"a closed loop needs the size of a count: state system.{key}.per_count in "
                f"{scale.unit} (the bench states it in {unit})"
            )
    if any(record.u is not None for record in analysis.records):
        sign = -1 if is_reversed(analysis.records) else 1
    else:
        sign = stated.input.sign or 1
    return CountScales(
        input=sign * (stated.input.per_count or bench.input_per_count),
        position=stated.position.per_count or bench.position_per_count,
    )


def controller_table(
    gains: StateGains | PidGains, *, cart: int, scales: CountScales, carts: int
) -> Table:
    """Return the `controller` entry of submission.toml for a recording with these gains.

    For a PID, `scale` is correct if the data file records positions in encoder counts.
    """
    if isinstance(gains, PidGains):
        table = {"kp": gains.kp, "ki": gains.ki, "kd": gains.kd}
        return {"type": "pid", **table, "scale": scales.input, "cart": cart}
    per_unit = scales.input / scales.position
    return {
        "type": "state_feedback",
        "gains": [_six_digits(per_unit * gain) for gain in gains.gains[: 2 * carts]],
        "prefilter": _six_digits(per_unit * gains.prefilter),
    }


def _six_digits(value: float) -> float:
    return float(f"{value:.6g}")


def rounded(value: float) -> float:
    """Return the number with two significant digits."""
    return float(f"{value:.2g}")


def _law(loop: StateLoop, design: FeedbackDesign | None) -> sampled_loop.StateFeedback:
    """Return the gains for the bench: those in the plan or, if none are stated, the design's."""
    if loop.gains and loop.prefilter is not None:
        return sampled_loop.StateFeedback(gains=np.array(loop.gains), prefilter=loop.prefilter)
    if design is None:
        raise DataError("there is no controller to run; `cartlab report` says why")
    if design.cart != loop.cart:
        raise DataError(
            f"the controller is designed for cart {design.cart}, but the plan has cart "
            f"{loop.cart}: change one, or state the gains"
        )
    return sampled_loop.StateFeedback(gains=design.gains, prefilter=design.prefilter)


@dataclass(frozen=True, kw_only=True)
class LoopTrial:
    """The step of a recording, simulated on the identified carts as the bench will run it."""

    recording: Recording
    submission: Submission
    analysis: Analysis
    bench: Description
    limits: PlanLimits

    @cached_property
    def chain(self) -> Chain:
        """The identified carts."""
        fit = self.analysis.fit
        if fit is None or not fit.converged:
            raise DataError("a closed loop needs identified carts")
        return fit.chain

    @cached_property
    def scales(self) -> CountScales:
        """The size of a count in the units of the submission."""
        return bench_scales(self.submission, bench=self.bench, analysis=self.analysis)

    def gains(self) -> StateGains | PidGains:
        """Return the gains to send to the bench before a closed-loop recording.

        Errors do not name the recording; the caller adds its name.

        Raises
        ------
        DataError : the carts are not identified, or the loop on the bench would be unstable, pass a
            limit, or miss its design goal.
        """
        n, loop, design = self.chain.n, self.recording.controller, self.analysis.feedback
        per_count = self.scales.position / self.scales.input
        if isinstance(loop, PidLoop):
            self._refuse_pid(loop)
            return PidGains(kp=loop.kp, ki=loop.ki, kd=loop.kd)
        if loop is None:
            raise DataError("it has no controller")
        law = _law(loop, design)
        goal = None if loop.gains else self.submission.design or Design(cart=loop.cart)
        self._refuse_state(law, cart=loop.cart, goal=goal, design=design)
        spare = [0.0] * (2 * (self.bench.encoders - n))  # zero gains for encoders without a cart
        return StateGains(
            gains=(*(per_count * law.gains).tolist(), *spare), prefilter=per_count * law.prefilter
        )

    def propose_pid(self) -> PidLoop:
        """Return PID gains on cart 1 for a bench without state feedback.

        The gains add stiffness and damping, and bring the cart to the reference. On a cart without
        the motor, a PID soon becomes unstable; on the driven cart it hardly ever does.

        Raises
        ------
        DataError : the carts are not identified, or all gains tried are unstable or pass a limit.
        """
        chain, counts = self.chain, self.scales.position / self.scales.input
        stiffness, slowest = 1 / chain.static_gains()[0], float(np.min(np.abs(chain.poles)))
        refused = ""
        for damped, share in product((True, False), _PID_SHARES):
            kp = share * stiffness
            # This gives a damping ratio of 0.5, with all carts as one mass.
            damping = 2 * 0.5 * float(np.sqrt((stiffness + kp) * chain.m.sum()))
            loop = PidLoop(
                kp=rounded(counts * kp),
                ki=rounded(counts * kp * slowest * 0.25),  # slower than any pole
                kd=rounded(counts * damping) if damped else 0.0,
            )
            try:
                self._refuse_pid(loop)
            except DataError as error:
                refused = str(error)
            else:
                return loop
        raise DataError(f"no PID is proposed: {refused}")

    def _refuse_state(
        self,
        law: sampled_loop.StateFeedback,
        *,
        cart: int,
        goal: Design | None,
        design: FeedbackDesign | None,
    ) -> None:
        """Raise DataError if the loop is unstable, passes a limit or misses its goal."""
        reference = self.recording.amplitude
        if not stays_stable(self.chain, law, sample_time=self.bench.period):
            raise DataError(
                f"with these gains the loop may be unstable at the bench's period of "
                f"{1e3 * self.bench.period:g} ms{self._advice(goal)}"
            )
        t, x = self._step(law, delay=1)
        if goal is None or design is None:
            return
        y, judged = x[cart - 1], {"before": 0.0, "level": np.float64(reference)}
        overshoot = float(simulate.overshoot_percent(y, **judged))
        settling = float(simulate.settling_time(t, y, **judged))
        # An overshoot of two counts cannot be distinguished from the encoder's flicker.
        unseen = 100 * 2 * self.scales.position / abs(reference)
        # If the design itself misses its goal, the report already says so.
        most = max(goal.overshoot_percent, design.overshoot_percent) + unseen
        longest = max(goal.settling_time, design.settling_time or np.inf)
        if overshoot > most or not settling <= longest + design.sample_time:
            raise DataError(
                f"on the bench the step would overshoot by {overshoot:.2g} % and settle in "
                f"{settling:.2g} s, but the design has {most:.2g} % and {longest:.2g} s"
                f"{self._advice(goal)}"
            )

    def _refuse_pid(self, loop: PidLoop) -> None:
        """Raise DataError if the loop is unstable or passes a limit."""
        if loop.cart > self.chain.n:
            raise DataError(f"there is no cart {loop.cart} to control")
        law = sampled_loop.Pid(
            kp=loop.kp,
            ki=loop.ki,
            kd=loop.kd,
            scale=self.scales.input / self.scales.position,
            cart=loop.cart,
        )
        matrix = sampled_loop.loop_matrix(self.chain, law, sample_time=self.bench.period)
        if np.abs(np.linalg.eigvals(matrix)).max() >= 1.0:
            raise DataError(
                f"with kp = {loop.kp:g}, ki = {loop.ki:g}, kd = {loop.kd:g} "
                f"on cart {loop.cart} the loop is unstable"
            )
        self._step(law, delay=0)

    def _advice(self, goal: Design | None) -> str:
        if goal is None:
            return ""
        return f": set design.sample_time = {self.bench.period:g} in submission.toml"

    def _step(self, law: sampled_loop.Controller, *, delay: int) -> tuple[Array, Array]:
        """Return t (n,) and positions (n_carts, n) of the step.

        A step that passes a limit is refused.
        """
        run = self.recording
        seconds = min(run.duration, 10.0)  # s of the step to simulate
        motion = sampled_loop.simulate_loop(
            self.chain,
            law,
            t=np.arange(0.0, seconds, self.bench.period),
            reference=run.amplitude,
            setup=sampled_loop.LoopSetup(
                sample_time=self.bench.period,
                delay=delay,
                input_limit=FULL_SCALE * abs(self.scales.input),
                encoder_step=self.scales.position,
            ),
        )
        asked, reached = np.abs(motion.u).max(), np.abs(motion.x).max()
        if asked > self.limits.input:
            raise DataError(
                f"the step needs an input of {asked:.3g}, but the limit is "
                f"{self.limits.input:g}: make the amplitude or the gains smaller"
            )
        if reached > self.limits.travel:
            raise DataError(
                f"the step moves a cart by {reached:.3g}, but the travel limit is "
                f"{self.limits.travel:g}: make the amplitude smaller"
            )
        return motion.t, motion.x
