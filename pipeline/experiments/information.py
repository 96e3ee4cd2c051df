"""The Fisher information that a record will give on the carts, predicted before it is made.

The prediction follows from the fit that will use the record. H is the information: the squared
derivatives of the motion with respect to the parameters, relative to the noise, with the initial
state and the encoder zeros eliminated. S is the covariance that the noise causes in the gradient of
the fit. It equals H for white noise and is larger if rounding errors persist over many samples. H
and S add up over records, and the covariance of the parameters is H⁻¹ S H⁻¹.

References: E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data,
1997, chapter 6; G. C. Goodwin, R. L. Payne, Dynamic System Identification: Experiment Design and
Data Analysis, 1977, chapter 6; for noise that is not white L. Ljung, System Identification, 2nd
ed., section 9.5.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
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
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import SETTLED_DWELL, settling_wait, simulate_linear
from pipeline.protocol import Start, Tone, Wave, shape_at
from pipeline.results import Analysis, ChainFit, FrequencyResponse, Record, SinePoint


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
    dwells: tuple[SinePoint, ...] = ()
    misfit: float = 0.0

    @classmethod
    def of(cls, analysis: Analysis) -> Self:
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
        t, u = self.input(recording)
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

    def _response(self, omega: Array, carts: Iterable[int]) -> list[FrequencyResponse]:
        G = self.chain.frequency_response(omega)
        return [
            FrequencyResponse(
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

    def input(self, recording: Recording) -> tuple[Array, Array]:
        """Return the bench's sample times (n,) in s, and the input (n,) at unit amplitude."""
        return sampled_input(recording, period=self.sample_time)

    def at_its_limits(self, recording: Recording, *, limits: PlanLimits, share: float) -> float:
        """Return the largest amplitude within the input limit and this `share` of the travel."""
        t, u = self.input(recording)
        x = simulate_linear(self.chain, t, u, free=recording.carts)
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


def _fitted_records(analysis: Analysis, fit: ChainFit) -> list[Record]:
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
    runs: Sequence[Record] | Sequence[FitWindow], values: Sequence[Array], *, n: int
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
