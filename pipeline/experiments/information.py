"""The Fisher information of a record, predicted before it is made, and the goal of experiments."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, Self, TypeAlias

import numpy as np

from pipeline import results
from pipeline.arrays import Array
from pipeline.errors import ConfigError, DataError
from pipeline.estimation.bode_fit import Points, response_at, weighted_residuals
from pipeline.estimation.noise import noise_beyond_rounding, score_covariance
from pipeline.estimation.parametrisation import (
    Parametrisation,
    critical_damping,
    parameter_jacobian,
)
from pipeline.estimation.time_fit import FitWindow, evaluate_chain, open_window, weighed
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.experiments.propose import identified_chain
from pipeline.names import names_beginning
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import LoopSetup, simulate_loop
from pipeline.plant.simulate import SETTLED_DWELL, settling_wait, simulate_linear
from pipeline.protocol import Start, Tone, Wave, shape_at
from pipeline.submission.toml import nearest

# ------------------------------------------------------------------- the information of a record
#
# The prediction follows from the fit that will use the record. H is the information: the squared
# derivatives of the motion with respect to the parameters, relative to the noise, with the initial
# state and the encoder zeros eliminated. S is the covariance that the noise causes in the gradient
# of the fit. It equals H for white noise and is larger if rounding errors persist over many
# samples. H and S add up over records, and the covariance of the parameters is H⁻¹ S H⁻¹.
#
# References: E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data,
# 1997, chapter 6; G. C. Goodwin, R. L. Payne, Dynamic System Identification: Experiment Design and
# Data Analysis, 1977, chapter 6; for noise that is not white L. Ljung, System Identification, 2nd
# ed., section 9.5.


@dataclass(frozen=True, kw_only=True, eq=False)
class FisherInformation:
    """The information in the records so far, and the precision of the next ones.

    Attributes
    ----------
    chain : the identified chain.
    information : (2, n_p, n_p) H and S for relative changes of the parameters; see
        `parametrisation`.
    size : (n_p,) parameter values in physical units to which these changes are relative.
    step, noise : (n,) encoder step and other noise of each cart, in position units.
    sample_time : sample time of the bench in s.
    beyond : ratio of the measured variances to those that encoder errors alone would cause.
        Friction, for example, increases it.
    dwells : the dwells so far. If there are any, only they are used to identify the carts.
    misfit : deviation of a dwell from the identified carts beyond its standard error, as a share of
        the dwell's magnitude.
    """

    chain: Chain
    parametrisation: Parametrisation
    information: Array
    size: Array
    step: Array
    noise: Array
    sample_time: float
    beyond: float = 1.0
    dwells: tuple[results.SinePoint, ...] = ()
    misfit: float = 0.0

    @classmethod
    def of(cls, analysis: results.Analysis) -> Self:
        """Return the information in the records of a submission.

        Raises
        ------
        DataError : the carts are not identified, or they are identified only from a table.
        """
        chain = identified_chain(analysis)
        fit = analysis.fit
        assert fit is not None
        everything = Parametrisation(bench=analysis.bench)
        gone = tuple(name for name in everything.names if name not in fit.names)
        P = everything.holding_at_zero(*gone)
        # The fit held some dampings at zero, but their logarithm needs a finite value here.
        undamped = 1e-6 * critical_damping(chain)
        chain = Chain(m=chain.m, c=np.where(chain.c > 0, chain.c, undamped), k=chain.k)
        value = P.physical(chain)
        size = np.where(value > 0, value, np.max(chain.k))  # a wall spring may be almost zero
        records = _fitted_records(analysis, fit)
        covariance = np.asarray(fit.covariance / np.outer(size, size), dtype=np.float64)
        known = cls(
            chain=chain,
            parametrisation=P,
            information=np.tile(np.asarray(np.linalg.inv(covariance), dtype=np.float64), (2, 1, 1)),
            size=size,
            step=_median_by_cart(records, [r.resolution for r in records], n=chain.n),
            noise=np.zeros(chain.n),
            sample_time=float(np.median([record.sample_time for record in records])),
            dwells=analysis.sine_points if fit.method == "bode_fit" else (),
            misfit=fit.misfit,
        )
        if known.dwells:
            return known
        windows = [open_window(record) for record in records]
        left = [
            np.array([fit.standardised[f"{w.id} cart {cart}"] for cart in w.carts])
            * w.stated_sigma[:, None]
            for w in windows
        ]
        moving = [w.rms_in_motion(one) for w, one in zip(windows, left, strict=True)]
        windows = [w.informed(one, at_rest=True) for w, one in zip(windows, left, strict=True)]
        total = _median_by_cart(windows, moving, n=chain.n)
        shaken = [
            noise_beyond_rounding(rms, step=one) for rms, one in zip(total, known.step, strict=True)
        ]
        return replace(known, noise=np.array(shaken))._compared(windows, covariance)

    def _compared(self, windows: Sequence[FitWindow], covariance: Array) -> Self:
        """Return a copy with H from the windows, and with S such that H⁻¹ S H⁻¹ is `covariance`.

        `beyond` becomes the ratio of the measured variances to those from encoder errors alone; it
        is at least 1.
        """
        H, S = np.sum([self._of_window(window) for window in windows], axis=0)
        J, inverse = self.by_parameters(), np.linalg.inv(H)
        found, expected = (np.diag(J @ C @ J.T) for C in (covariance, inverse @ S @ inverse))
        beyond = max(1.0, float(np.median(found / expected)))
        return replace(self, information=np.stack([H, H @ covariance @ H]), beyond=beyond)

    def by_parameters(self) -> Array:
        """Return the derivatives (n_named, n_p) of the named parameters.

        They are relative changes per relative change of the physical parameters. The named
        parameters are in table order.
        """
        J = parameter_jacobian(self.chain, self.parametrisation.names) * self.size
        return J / np.array(list(self.chain.parameters().values()))[:, None]

    # -------------------------------------------------------- the information in a record

    def of_recording(self, recording: Recording) -> Array:
        """Return H and S (2, n_p, n_p) of a recording with all carts free, starting from rest."""
        if recording.kind == "sine":
            return self._of_dwell(recording)
        t, u = sampled_input(recording, period=self.sample_time)
        sigma = np.hypot(self.step / np.sqrt(12), self.noise)
        window = FitWindow(
            id=recording.id,
            kind=recording.kind,
            t=t,
            y=np.zeros((self.chain.n, t.size)),
            drive_t=t,
            drive_u=recording.amplitude * u,
            stride=1,
            carts=recording.carts,
            free=recording.carts,
            stated_sigma=sigma,
            sigma=sigma,
            step=self.step,
            at_rest=True,
        )
        noise = np.broadcast_to(sigma[:, None], window.y.shape)
        window = window.informed(noise, at_rest=True)
        return self._of_window(window) * np.array([1.0, self.beyond])[:, None, None]

    def _of_window(self, window: FitWindow) -> Array:
        """Return H and S of a window, with positions rounded as the encoders round them."""
        rows = [cart - 1 for cart in window.carts]
        theta = self.parametrisation.pack(self.chain)
        (misfit,) = evaluate_chain([window], self.parametrisation, theta).misfits
        J = misfit.jacobian * (self.size / self.parametrisation.dp_dtheta(theta))[:, None, None]
        exact = window.y + misfit.residual * window.sigma[:, None]
        resting = window.n_resting
        exact[:, :resting] = exact[:, [resting]]  # first residual with its full weight
        flat = J.reshape(theta.size, -1)
        S = np.mean(
            [score_covariance(weighed(off, window), J) for off in self._errors(exact, rows)], axis=0
        )
        return np.stack([flat @ flat.T, S])

    def _errors(self, exact: Array, rows: list[int]) -> Iterator[Array]:
        """Yield several random draws of the encoder errors (p, n) for exact positions (p, n)."""
        rng, step = np.random.default_rng(0), self.step[rows, None]
        for _ in range(3):  # a single sample would be too random
            # An encoder starts anywhere between two counts.
            from_count = exact + step * rng.uniform(-0.5, 0.5, size=step.shape)
            read = from_count + self.noise[rows, None] * rng.standard_normal(exact.shape)
            whole = step * np.round(read / np.where(step > 0, step, 1.0))
            yield np.where(step > 0, whole, read) - from_count

    def _of_dwell(self, recording: Recording) -> Array:
        """Return H and S of a dwell; it is taken to be as precise as the dwells so far."""
        steady = recording.duration - settling_wait(self.chain, time_constants=SETTLED_DWELL)
        samples = max(steady / self.sample_time, 1.0)
        omega, responses = np.array([2 * np.pi * recording.frequency]), []
        for response in self._response(omega, recording.carts):
            mine = [p for p in self.dwells if p.cart == response.cart] or list(self.dwells)
            share = np.sqrt([p.n_points / samples for p in mine]) / abs(recording.amplitude)
            std = float(np.median(share * [p.amplitude_std for p in mine]))
            turned = float(np.median(share * [p.phase_std * p.amplitude for p in mine]))
            phase_std = turned / response.magnitude
            responses.append(replace(response, magnitude_std=np.full(1, std), phase_std=phase_std))
        data = Points.collect(responses, n=self.chain.n).widened(self.misfit)
        P = self.parametrisation
        _, J = weighted_residuals(P, data, "polar", P.physical(self.chain))
        J = J * self.size
        return np.tile(J.T @ J, (2, 1, 1))

    def of_lines(self, omega: Array, *, amplitude: Array, seconds: float) -> Array:
        """Return H and S (n, 2, n_p, n_p), one pair for each steady sine; `omega` is in rad/s.

        The sines move the carts by many counts, so rounding errors are white.
        """
        P, carts = self.parametrisation, range(1, self.chain.n + 1)
        data = Points.collect(self._response(omega, carts), n=self.chain.n)
        _, dG = response_at(P, data, P.physical(self.chain))
        sigma = np.hypot(self.step / np.sqrt(12), self.noise)
        dG = dG.reshape(self.chain.n, omega.size, -1) * self.size
        dG = dG * (amplitude[:, None] / sigma[:, None, None])
        samples = seconds / self.sample_time / 2  # the mean square of a sine is a half
        H = samples * np.einsum("cwp,cwq->wpq", np.conj(dG), dG).real
        return np.stack([H, self.beyond * H], axis=1)

    def _response(self, omega: Array, carts: Iterable[int]) -> list[results.FrequencyResponse]:
        G = self.chain.frequency_response(omega)
        return [
            results.FrequencyResponse(
                cart=cart,
                omega=omega,
                magnitude=np.abs(G[cart - 1]),
                magnitude_std=np.ones(omega.size),
                phase=np.angle(G[cart - 1]),
                phase_std=np.ones(omega.size),
                source="dwells",
            )
            for cart in carts
        ]


def largest_amplitude(
    chain: Chain, recording: Recording, *, limits: PlanLimits, share: float, period: float
) -> float:
    """Return the largest amplitude within the input limit and this `share` of the travel."""
    t, u = sampled_input(recording, period=period)
    x = simulate_linear(chain, t, u, free=recording.carts)
    return min(share * limits.travel / float(np.max(np.abs(x))), limits.input)


def sampled_input(recording: Recording, *, period: float) -> tuple[Array, Array]:
    """Return times (n,) every `period` s and the recording's input (n,) at unit amplitude."""
    start = Start(
        wave=Wave[recording.wave.upper()],
        frequency=recording.frequency,
        amplitude=1,
        cycles=recording.cycles,
    )
    return _sampled(start, recording.duration, period, recording.frequency_end, recording.sines)


# Large enough for all candidates, as each one is used at least twice.
@lru_cache(maxsize=64)
def _sampled(
    start: Start, duration: float, period: float, end: float | None, tones: tuple[Tone, ...]
) -> tuple[Array, Array]:
    t = np.arange(0.0, duration, period)
    u = np.array([shape_at(start, at, chirp_end=end, tones=tones) for at in t.tolist()])
    for array in (t, u):
        array.flags.writeable = False
    return t, u


def _fitted_records(analysis: results.Analysis, fit: results.ChainFit) -> list[results.Record]:
    """Return the records used in the fit.

    Raises
    ------
    DataError : the fit used a table, which has no records.
    """
    kinds = ("sine",) if fit.method == "bode_fit" else ("step", "sweep")
    out = {one.experiment for one in analysis.left_out}
    records = [
        record
        for record in analysis.records
        if record.kind in kinds and record.id not in out and len(record.free) == analysis.bench.n
    ]
    if not records:
        raise DataError(
            "a prediction needs the noise of earlier records, and a table has no noise: "
            "record a sweep first"
        )
    return records


def _median_by_cart(
    runs: Sequence[results.Record] | Sequence[FitWindow], values: Sequence[Array], *, n: int
) -> Array:
    """Return each cart's median (n,) of a value over the runs in which it was measured."""
    found = [
        [
            float(of_run[run.carts.index(cart)])
            for run, of_run in zip(runs, values, strict=True)
            if cart in run.carts
        ]
        for cart in range(1, n + 1)
    ]
    return np.array([np.median(of_cart) if of_cart else 0.0 for of_cart in found])


# ------------------------------------------------ the goal: which errors to reach, as one number

GAP = "gap"  # the goal of distinguishing the explanations of a gap
DESIGN, WORST, MEAN, VOLUME = "design", "worst", "mean", "volume"
Mean: TypeAlias = Literal["largest", "root mean square", "volume"]
# The goals that concern all parameters: words, and how their errors become one number.
_OVER_ALL: dict[str, tuple[str, Mean]] = {
    WORST: ("the error of the least known parameter", "largest"),
    MEAN: ("the mean error of all parameters", "root mean square"),
    VOLUME: ("the mean error of masses, damping coefficients and stiffnesses", "volume"),
}
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
    mean: Mean = "largest"

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


def find_goal(
    name: str, known: FisherInformation, *, feedback: results.FeedbackDesign | None
) -> Goal:
    """Return the goal with this name: a parameter, "design", "worst", "mean" or "volume".

    Raises
    ------
    ConfigError : there is no such goal.
    DataError : the goal is "design", but no feedback was designed.
    """
    values, rows = known.chain.parameters(), known.by_parameters()
    check_goal(name, names=[*values])
    if name in _OVER_ALL:
        words, mean = _OVER_ALL[name]
        return Goal(name=name, words=words, rows=rows, mean=mean)
    if name == DESIGN:
        if feedback is None:
            raise DataError("--for design: no controller is designed: add a [design] table first")
        row = _by_overshoot(known, feedback)
        return Goal(name=name, words="the error of the predicted overshoot", rows=row)
    at = list(values).index(name)
    return Goal(name=name, words=f"the error of {name}", rows=rows[at : at + 1])


def _by_overshoot(known: FisherInformation, feedback: results.FeedbackDesign) -> Array:
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
