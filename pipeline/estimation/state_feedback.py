"""Design state feedback with a prefilter, so that one cart follows a step.

The design is for sampled control, and its model includes the computer's one-sample delay: the gains
multiply the state predicted for the moment at which the effort acts (`plant.sampled_loop`). So
with 2n gains, the loop has the poles of Phi - Gamma G, and one at z = 0 for the delay.

Method "lqr" weights energy against the input, alpha times the potential and beta times the kinetic
energy, and searches both weights. Method "poles" is the design by hand. A dominant pair of poles
replaces the plant's slowest pair. The other pairs keep the plant's own frequencies, with more
damping, and are varied. Among the candidates whose simulated step meets the goal, both methods
consider those with the smallest inputs, and choose the fastest.
"""

from contextlib import suppress
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.linalg import hadamard, hessenberg
from scipy.optimize import linear_sum_assignment

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.plant import sampled_loop, simulate
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.simulate import simulate_linear
from pipeline.results import FeedbackDesign
from pipeline.submission import Design

# --------------------------------------- gains, the sampled plant, and how far plants may differ

# Relative errors that a design must tolerate: one for identified masses and springs, one for
# dampings. Between driven and free motion, a real cart's damping differs by a quarter and its
# spring by some percent.
MASS_SPRING_ERROR, DAMPING_ERROR = 0.03, 0.30


def lqr_gains(phi: Array, gamma: Array, weights: Array) -> Array:
    """Return the gains (…, n) that minimise the sum of x'Qx + u² for each Q in `weights` (…, n, n).

    This is the doubling algorithm: after i steps, H is the cost of the next 2^i samples. Many
    weights at once take little more time than one.

    Raises
    ------
    LinAlgError : the plant's numbers differ by too many orders of magnitude.

    Reference: E. K. Chu, H. Fan, W. Lin, Linear Algebra Appl. 396 (2005) 55-80.
    """
    eye = np.eye(gamma.size)
    A, H = np.broadcast_to(phi, weights.shape), weights
    G = np.broadcast_to(np.outer(gamma, gamma), weights.shape)
    for _ in range(60):  # after 2^60 samples, no loop depends on its start
        W, A_transposed = np.linalg.inv(eye + G @ H), np.swapaxes(A, -1, -2)
        more = A_transposed @ H @ W @ A
        G, A, H = G + A @ W @ G @ A_transposed, A @ W @ A, H + more
        if np.abs(more).max() <= np.finfo(float).eps * np.abs(H).max():
            break
    H_gamma = H @ gamma
    return (H_gamma @ phi) / (1 + H_gamma @ gamma)[..., None]


def place_poles(phi: Array, gamma: Array, poles: ComplexArray) -> Array:
    """Return the gains G (…, n) with which phi - gamma G has the `poles` (…, n).

    Complex poles must come in conjugate pairs. In Hessenberg form, the input reaches one state
    after the other. So the gains follow from the last row of the desired characteristic polynomial,
    evaluated at phi. No controllability matrix has to be inverted.

    Reference: B. N. Datta, Linear Algebra Appl. 88 (1987) 207-226.
    """
    rotation, beta = np.linalg.qr(gamma[:, None], mode="complete")
    H, basis = hessenberg(rotation.T @ phi @ rotation, calc_q=True)
    row = np.zeros(poles.shape, dtype=np.complex128)
    row[..., -1] = 1.0
    for i in range(gamma.size):
        row = row @ H - poles[..., i, None] * row
    reach = beta[0, 0] * np.prod(np.diag(H, -1))
    return row.real / reach @ basis.T @ rotation.T


def stays_stable(
    chain: Chain, controller: sampled_loop.StateFeedback, *, sample_time: float
) -> bool:
    """Return whether the loop is stable on all plants within the errors of identification.

    A two-level screening design, together with its mirror image, gives 32 plants. They cover every
    main effect of the errors and many combinations, for up to four carts.

    Reference: R. L. Plackett, J. P. Burman, Biometrika 33 (1946) 305-325.
    """
    n = chain.n
    signs = hadamard(16)[:, 1 : 3 * n + 2]  # the first column is constant
    matrices = []
    for sign in np.vstack([signs, -signs]):
        stiff, heavy, damped = np.split(sign, [n + 1, 2 * n + 1])
        plant = Chain(
            m=chain.m * (1 + MASS_SPRING_ERROR * heavy),
            c=chain.c * (1 + DAMPING_ERROR * damped),
            k=chain.k * (1 + MASS_SPRING_ERROR * stiff),
        )
        matrices.append(sampled_loop.loop_matrix(plant, controller, sample_time=sample_time))
    return bool(np.abs(np.linalg.eigvals(np.array(matrices))).max() < 1.0)


def level_error_percent(chain: Chain, gains: Array, *, cart: int) -> Array:
    """Return how far errors in the springs move a cart's steady position, for gains (…, 2n).

    The result is in percent of the steady position, to first order, with the errors of all springs
    in the worst direction.
    """
    inverse = _compliance(chain, gains)
    x = inverse[..., :, 0]
    # Spring j adds k_j (e_j - e_{j-1})(e_j - e_{j-1})' to the stiffness, where e_j is the unit
    # vector of cart j, or zero for a wall.
    ends = np.diff(np.eye(chain.n + 2)[1:-1], axis=1)  # (n, n + 1), one column per spring
    moved = chain.k * (x @ ends) * (inverse[..., cart - 1, :] @ ends)
    return 100 * MASS_SPRING_ERROR * np.abs(moved).sum(-1) / np.abs(x[..., cart - 1])


def static_levels(chain: Chain, gains: Array) -> Array:
    """Return the steady positions (…, n) of all carts under gains (…, 2n), per unit of input."""
    return _compliance(chain, gains)[..., :, 0]


def _compliance(chain: Chain, gains: Array) -> Array:
    """Return the inverse (…, n, n) of the stiffness under feedback."""
    fed_back = np.eye(chain.n)[:, :1] * gains[..., None, 0::2]
    return np.asarray(np.linalg.inv(chain.stiffness + fed_back), dtype=np.float64)


class SampledPlant:
    """A chain, sampled fast enough for its modes and for the desired settling time (s).

    It is in scaled units: v is divided by `rate` (rad/s), and u by `stiffness` (input unit per
    position unit). `phi` is (2n, 2n), `gamma` (2n,).

    Raises
    ------
    LinAlgError : the poles are so fast that the sampled plant is not finite.
    """

    def __init__(
        self, chain: Chain, *, cart: int, settling: float, sample_time: float | None
    ) -> None:
        self.chain, self.cart = chain, cart
        speeds = np.maximum(np.abs(chain.poles), 4 / settling)
        self.rate = float(np.exp(np.log(speeds).mean()))
        if sample_time is None:
            # The laboratory controller's sample time, or less if modes are fast, or if the loop
            # would settle in less than 25 samples.
            sample_time = min(0.00884, sampled_loop.RADIANS_PER_STEP / speeds.max(), settling / 25)
        self.sample_time = float(sample_time)
        held = 1 / chain.static_gains()[0] if chain.is_tied else chain.m.sum() * self.rate**2
        self.stiffness = float(held)
        self.phi, self.gamma = self.after(1.0)
        if not (np.all(np.isfinite(self.phi)) and np.all(np.isfinite(self.gamma))):
            raise np.linalg.LinAlgError("the sampled plant is not finite")

    @property
    def row(self) -> int:
        """The index of the state that is the position of the cart."""
        return 2 * (self.cart - 1)

    def to_units(self, gains: Array) -> Array:
        """Return gains (…, 2n) in input unit per position unit and per (position unit/s)."""
        return gains * self.stiffness / np.tile([1.0, self.rate], self.chain.n)

    def cost_to_units(self, weights: Array) -> Array:
        """Return Q of the cost in which the input's square has the weight 1/stiffness."""
        unit = np.tile([1.0, self.rate], self.chain.n)
        return self.stiffness * weights / np.outer(unit, unit)

    def after(self, share: float) -> tuple[Array, Array]:
        """Return phi and gamma, in scaled units, for a share of the sample time."""
        phi, gamma = sampled_loop.discretise(self.chain, share * self.sample_time)
        unit = np.tile([1.0, self.rate], self.chain.n)
        return phi * unit / unit[:, None], gamma * self.stiffness / unit

    def stays_stable(self, gains: Array) -> bool:
        """Whether the loop with these unscaled gains tolerates the usual errors of the chain."""
        controller = sampled_loop.StateFeedback(gains=gains, prefilter=1.0, model=self.chain)
        return stays_stable(self.chain, controller, sample_time=self.sample_time)


def energy_weights(plant: SampledPlant, weights: Array) -> Array:
    """Return Q (n_candidates, 2n, 2n) for all pairs of weights on potential and kinetic energy.

    The input's square has the weight R = 1.
    """
    chain, n = plant.chain, plant.chain.n
    stiffness = chain.stiffness / plant.stiffness
    if not chain.is_tied:
        # Without a spring to a wall, the mean position is weighted as if a spring held it.
        stiffness = stiffness + np.ones((n, n)) / n**2
    potential, kinetic = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    potential[0::2, 0::2] = stiffness
    kinetic[1::2, 1::2] = np.diag(chain.m) * plant.rate**2 / plant.stiffness
    alpha, beta = (w.ravel()[:, None, None] for w in np.meshgrid(weights, weights, indexing="ij"))
    return alpha * potential + beta * kinetic


# ---------------------------------------------------------------------- the stage

_POINTS = 512  # points of a candidate's step; a power of two, because doubling computes them

# Shares of the goal (settling time, overshoot) to aim at, the best first. The plant is known only
# to a few percent, but should still meet the goal.
_AIMS = ((0.8, 0.05), (0.8, 0.5), (1.0, 1.0))
_UNSEEN = 0.05  # percent; nobody notices a smaller overshoot

_WEIGHTS = np.logspace(-3, 4, 25)  # weights of energies, from no visible feedback to a stiff loop
_HEAVY_WEIGHTS = np.logspace(-3, 12, 40)  # up to almost deadbeat control
_DOMINANT_SETTLING = np.linspace(0.3, 1.0, 8)  # share of the goal
_FURTHER_ZETA = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7)  # least damping ratios; a pair may have more
_FURTHER_SPEED = (1.0, 1.25)  # relative to the plant's own frequency


def design_feedback(chain: Chain, task: Design) -> FeedbackDesign:
    """Design u = prefilter r - gains [x1, v1, x2, v2, …] for a step of one cart.

    If the goal cannot be met, `reachable` is False. The result is then the nearest design, with a
    message that says what is reachable. The settling time counts from the step of the reference, so
    it includes the delay. If no sample time is stated, it is 0.00884 s, or less for a fast plant or
    goal.

    Raises
    ------
    DataError : there is no such cart or step, a cart is out of reach, no design can be computed,
        every design overshoots more than no feedback, or the run takes too many ticks.
    """
    if not 1 <= task.cart <= chain.n:
        raise DataError(f"state feedback needs a cart from 1 to {chain.n}, found {task.cart}")
    if task.reference == 0:
        raise DataError("state feedback needs a reference other than 0")
    if np.any(chain.k[1:-1] <= 0):
        missing = int(np.argmax(chain.k[1:-1] <= 0)) + 1
        raise DataError(
            f"state feedback needs every cart within the motor's reach, found no spring between "
            f"carts {missing} and {missing + 1}"
        )
    try:
        # A candidate may be unstable and diverge, which its final numbers show.
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            plant = SampledPlant(
                chain, cart=task.cart, settling=task.settling_time, sample_time=task.sample_time
            )
            design = _design(plant, task)
            if chain.is_tied:
                _refuse_more_overshoot(plant, task, design)
            return design
    except np.linalg.LinAlgError:
        raise DataError(
            "state feedback needs masses, damping coefficients and stiffnesses within some ten "
            f"orders of magnitude, found m {_range(chain.m)}, c {_range(chain.c)}, "
            f"k {_range(chain.k)}"
        ) from None


def _refuse_more_overshoot(plant: SampledPlant, task: Design, design: FeedbackDesign) -> None:
    """Raise DataError if the design overshoots more than a step of the input without feedback."""
    slowest = float(np.abs(plant.chain.poles).min())
    t = np.linspace(0.0, max(float(design.t[-1]), 2 * np.pi / slowest), _POINTS)
    level = plant.chain.static_gains()[plant.cart - 1]
    alone = simulate_linear(plant.chain, t=t, u=np.ones_like(t))[plant.cart - 1]
    most = float(simulate.overshoot_percent(alone, before=0.0, level=level))
    if design.overshoot_percent <= most:
        return
    for halvings in range(1, 7):
        sample_time = plant.sample_time / 2**halvings
        faster = SampledPlant(
            plant.chain, cart=plant.cart, settling=task.settling_time, sample_time=sample_time
        )
        better = _design(faster, task)
        if better.reachable:
            advice = (
                f"set sample_time to {sample_time:.3g} s, where the design overshoots by "
                f"{better.overshoot_percent:.2g} %"
            )
            break
    else:
        advice = "no shorter sample time meets the goal, so relax the goal"
    raise DataError(
        f"state feedback needs to overshoot less than the {most:.3g} % of the carts without "
        f"feedback, found {design.overshoot_percent:.3g} % at best, sampled every "
        f"{plant.sample_time:.3g} s: {advice}"
    )


def _range(values: Array) -> str:
    return f"{values.min():.1e} to {values.max():.1e}"


def _design(plant: SampledPlant, task: Design) -> FeedbackDesign:
    """Choose among the candidates of the task's method, and simulate the chosen one."""
    if task.method == "lqr":
        requested, costs = None, energy_weights(plant, _WEIGHTS)
        candidates = _Candidates(plant, lqr_gains(plant.phi, plant.gamma, costs), task)
        best, met = _choose(plant, candidates, task)
        if not met:  # the goal may be much faster than the plant
            heavy = energy_weights(plant, _HEAVY_WEIGHTS)
            # At slow sampling, the heaviest weights have no solution in double precision.
            with suppress(np.linalg.LinAlgError):
                candidates = _Candidates(plant, lqr_gains(plant.phi, plant.gamma, heavy), task)
                best, met = _choose(plant, candidates, task)
                costs = heavy
    else:
        requested, costs = _pole_candidates(plant, task), None
        z = np.exp(requested * plant.sample_time)
        candidates = _Candidates(plant, place_poles(plant.phi, plant.gamma, z), task)
        best, met = _choose(plant, candidates, task)
    design = _finish(
        plant,
        task,
        gains=plant.to_units(candidates.gains[best]),
        requested=None if requested is None else requested[best],
        settling=float(candidates.settling[best]),
    )
    if costs is None:
        return design
    return replace(design, Q=plant.cost_to_units(costs[best]), R=1 / plant.stiffness)


# -------------------------------------------------------------- candidate gains


def _pole_candidates(plant: SampledPlant, task: Design) -> ComplexArray:
    """Return continuous pole sets (n_candidates, 2n), rad/s."""
    omega, zeta = quadratic_factors(plant.chain.poles)
    shares = np.array([overshoot for _, overshoot in _AIMS])
    log = np.log(np.maximum(shares * task.overshoot_percent, _UNSEEN) / 100)
    dominant_zeta = -log / np.hypot(np.pi, log)
    z, settling, further_zeta, further_speed = (
        axis.ravel()
        for axis in np.meshgrid(
            dominant_zeta, task.settling_time * _DOMINANT_SETTLING, _FURTHER_ZETA, _FURTHER_SPEED
        )
    )
    # exp(-4) is about the 2 % that define the settling time. No pair is made slower than the
    # plant's own pair, because a slower pair would cancel stiffness and leave a small difference of
    # large numbers.
    dominant = np.maximum(4 / (z * settling), omega[0])
    pairs = [_pair(dominant, z)]
    for own_omega, own_zeta in zip(omega[1:], zeta[1:], strict=True):
        further = np.maximum(own_omega, dominant) * further_speed
        pairs.append(_pair(further, np.maximum(own_zeta, further_zeta)))
    return np.concatenate(pairs, axis=-1)


def _pair(omega: Array, zeta: Array) -> ComplexArray:
    """Return the roots (n, 2) of s² + 2 zeta omega s + omega²."""
    spread = np.sqrt(zeta**2 - 1, dtype=np.complex128)
    roots = np.stack([spread - zeta, -spread - zeta], axis=-1)
    return np.asarray(omega[:, None] * roots, dtype=np.complex128)


# ------------------------------------------------------------ judging candidates


class _Candidates:
    """The response of each set of gains (n_candidates, 2n) to the goal's step, exact at its points.

    The points are close enough to show every peak, also between the ticks of a slow clock. If the
    simulation therefore ends before the goal's settling time, the settling time is estimated.

    Attributes
    ----------
    overshoot, level_error : percent of the step (n_candidates,); the latter is due to errors in the
        model.
    settling : s (n_candidates,); estimated from the slowest pole if the simulated step ends
        earlier.
    peak : input units (n_candidates,).
    """

    def __init__(self, plant: SampledPlant, gains: Array, task: Design) -> None:
        self.gains = gains
        loop = plant.phi - plant.gamma[:, None] * gains[:, None, :]
        fastest = np.abs(plant.chain.poles).max() + 4 / task.settling_time
        # The step is simulated for three times the goal's settling time, if there are enough points
        # for this.
        apart = min(3.0 * task.settling_time / _POINTS, sampled_loop.RADIANS_PER_STEP / fastest)
        stride = max(1, round(apart / plant.sample_time))
        parts = sampled_loop.parts_per_sample(plant.chain, plant.sample_time)
        level = np.linalg.solve(np.eye(plant.gamma.size) - loop, plant.gamma[:, None])
        prefilter = 1 / level[:, plant.row]
        level = level * prefilter[:, None]
        # In each sample, the distance to the level is multiplied by `loop`. Each pass doubles the
        # points.
        to_go, ahead = -level, np.linalg.matrix_power(loop, stride)
        while to_go.shape[-1] * parts < _POINTS:
            to_go, ahead = np.concatenate([to_go, ahead @ to_go], axis=-1), ahead @ ahead
        points = np.arange(to_go.shape[-1], dtype=np.float64)[:, None] + np.arange(parts) / parts
        t = plant.sample_time * (1 + stride * points.ravel())  # the first sample is the delay
        # The effort is held from tick to tick, so it belongs to the distance at the last tick.
        rows = [
            phi[plant.row] - gamma[plant.row] * gains
            for phi, gamma in (plant.after(part / parts) for part in range(parts))
        ]
        y = 1 + np.einsum("pci,cin->cnp", rows, to_go).reshape(len(gains), -1)
        # The input that holds the level is included, because a slow candidate may not be there yet.
        u = prefilter - np.einsum("ci,cin->cn", gains, np.append(to_go, 0 * level, axis=-1) + level)
        one = np.ones(len(gains))
        settling = t[0] + simulate.settling_time(t, y, before=0.0, level=one)
        radius = np.abs(np.linalg.eigvals(loop)).max(-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slowest = -4 * plant.sample_time / np.log(radius)
        self.overshoot = simulate.overshoot_percent(y, before=0.0, level=one)
        estimated = np.where(radius < 1, slowest, np.inf)
        self.settling = np.where(np.isnan(settling), estimated, settling)
        self.peak = np.abs(u).max(-1) * plant.stiffness * abs(task.reference)
        unscaled = plant.to_units(gains)
        self.level_error = level_error_percent(plant.chain, unscaled, cart=plant.cart)


def _choose(plant: SampledPlant, candidates: _Candidates, task: Design) -> tuple[int, bool]:
    """Return the index of the best candidate, and whether it meets the goal.

    If no candidate meets the goal, the index is that of the nearest one.
    """
    within = candidates.peak <= (np.inf if task.input_limit is None else task.input_limit)
    if not within.any():  # a step of this size is out of reach, so design for a smaller one
        within = np.full_like(within, True)
    # Errors in the springs should move the steady position by at most 10 % of the step.
    for level_error, (settling, overshoot) in product((10.0, np.inf), _AIMS):
        good = within & (candidates.level_error <= level_error)
        good &= candidates.settling <= settling * task.settling_time
        good &= candidates.overshoot <= max(overshoot * task.overshoot_percent, _UNSEEN)
        if not good.any():
            continue
        # A faster candidate may need up to 1.25 times the least peak input of all good candidates.
        good &= candidates.peak <= 1.25 * candidates.peak[good].min()
        order = np.flatnonzero(good)[np.argsort(candidates.settling[good], kind="stable")]
        # The first eight are tried until one gives a loop that is stable for all errors of the
        # model.
        for index in order[:8]:
            if plant.stays_stable(plant.to_units(candidates.gains[index])):
                return int(index), True
    excess = np.maximum(
        candidates.settling / task.settling_time,
        np.maximum(candidates.overshoot, 1.0) / max(task.overshoot_percent, 1.0),
    )
    return int(np.argmin(np.where(within & ~np.isnan(excess), excess, np.inf))), False


# ------------------------------------------------------------------- the result


def _finish(
    plant: SampledPlant,
    task: Design,
    *,
    gains: Array,
    requested: ComplexArray | None,
    settling: float,
) -> FeedbackDesign:
    """Simulate the chosen design with delay and input limit, and describe the result."""
    chain, T = plant.chain, plant.sample_time
    phi, gamma = sampled_loop.discretise(chain, T)
    loop = phi - np.outer(gamma, gains)
    prefilter = 1 / float(np.linalg.solve(np.eye(2 * chain.n) - loop, gamma)[plant.row])
    z = np.linalg.eigvals(loop).astype(np.complex128)
    poles = np.asarray(np.log(z) / T, dtype=np.complex128)
    if requested is not None:
        away = np.abs(requested[None, :] - poles[:, None])
        requested = requested[linear_sum_assignment(away)[1]]
    # The result shows twice the goal's or the design's settling time, whichever is longer. If the
    # design misses the goal, the result shows at most 20 times the goal's settling time.
    shown = 2.0 * min(max(task.settling_time, settling), 10.0 * task.settling_time)
    sampled_loop.check_ticks(shown, T)
    parts = sampled_loop.parts_per_sample(chain, T)
    t = T / parts * np.arange(parts * np.ceil(shown / T) + 1, dtype=np.float64)
    run = sampled_loop.simulate_loop(
        chain,
        sampled_loop.StateFeedback(gains=gains, prefilter=prefilter, model=chain),
        t=t,
        reference=task.reference,
        setup=sampled_loop.LoopSetup(sample_time=T, input_limit=task.input_limit),
    )
    y = run.x[plant.cart - 1]
    judged = {"before": 0.0, "level": np.float64(task.reference)}
    overshoot = float(simulate.overshoot_percent(y, **judged))
    settling = float(simulate.settling_time(t, y, **judged))
    met = overshoot <= task.overshoot_percent + _UNSEEN and settling <= task.settling_time + T / 2
    design = FeedbackDesign(
        cart=plant.cart,
        method=task.method,
        reference=task.reference,
        gains=gains,
        prefilter=prefilter,
        poles=poles,
        requested_poles=requested,
        sample_time=T,
        overshoot_percent=overshoot,
        settling_time=None if np.isnan(settling) else settling,
        peak_input=float(np.abs(run.u).max()),
        t=t,
        y=run.x,
        u=run.u,
        reachable=bool(met),
        message="",
    )
    return replace(design, message=_message(plant, task, design))


def _message(plant: SampledPlant, task: Design, design: FeedbackDesign) -> str:
    """Return a warning if the goal cannot be met or model errors matter; otherwise ""."""
    parts = []
    limit, held = task.input_limit, np.inf
    if plant.chain.is_tied and limit is not None:
        held = abs(plant.chain.static_gains()[plant.cart - 1]) * limit
    if not design.reachable and abs(task.reference) > held:
        parts.append(
            f"an input of ±{limit:.3g} cannot hold cart {plant.cart} at "
            f"{task.reference:.3g}; it reaches at most {held:.3g}"
        )
    elif not design.reachable:
        settling = design.settling_time
        settles = "does not settle" if settling is None else f"settles in {settling:.3g} s"
        within = "" if limit is None else f" within ±{limit:.3g} of input"
        parts.append(
            f"overshoot {task.overshoot_percent:.3g} % and settling in {task.settling_time:.3g} s"
            f"{within} cannot be met: the best design overshoots by "
            f"{design.overshoot_percent:.2g} % and {settles}, with an input of "
            f"{design.peak_input:.3g}"
        )
    if not plant.stays_stable(design.gains):
        parts.append(
            f"the loop may be unstable if masses or springs are off by {100 * MASS_SPRING_ERROR:g} "
            f"%, or damping coefficients by {100 * DAMPING_ERROR:g} %"
        )
    error = float(level_error_percent(plant.chain, design.gains, cart=plant.cart))
    if error > 5.0:
        parts.append(
            f"these gains cancel much of the plant's own stiffness: errors of "
            f"{100 * MASS_SPRING_ERROR:g} % in the springs move the level by up to {error:.0f} %"
        )
    return "; ".join(parts)
