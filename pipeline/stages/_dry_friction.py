"""Dry friction in a free decay: the exact piecewise solution, fitted and tested.

With viscous damping and dry friction F the cart swings about k d to one side while it moves one
way and about the other while it moves back (d = F/k), so that A_{j+1} = rho A_j - (1 + rho) d.

Reference: B. F. Feeny and J. W. Liang, J. Sound and Vibration 195 (1996) 149-154.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pipeline.plant.chain import Array
from pipeline.results import FrictionTest
from pipeline.stages._ringing import Ringing
from pipeline.stages._signals import colour

THRESHOLD = 10.8  # F(1, many) above this once in a thousand decays without friction
_UNKNOWNS = 7
_MAX_EVALUATIONS = 200  # a decay takes some 30, derivatives included
_MOST_LOSS = 50.0  # of an exponent on the way to the fit: beyond, numbers run over
_ONE_START = 1.5  # residual over noise without friction: up to here there is little, if any
_LESS_DAMPING = (1.0, 0.3)  # starts: friction takes a share of the damping fitted without it


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionFit:
    """The test's outcome and the decay with friction, as a function of time."""

    test: FrictionTest
    model: Callable[[Array], Array]


def fit_friction(
    t: Array, y: Array, *, viscous: Ringing, turning: float, falling: bool, floor: float
) -> FrictionFit | None:
    """Fit a decay with viscous damping and dry friction; compare with viscous damping alone.

    Variable projection over (turning point, decay rate, frequency); rest point, drift, first
    amplitude and friction band are linear. The F-statistic allows for a coloured residual.

    Parameters
    ----------
    t, y : (n,) one free decay.
    viscous : the fit without friction, to the same samples.
    turning : s, a turning point of the cart, about; `falling`: it moves to smaller y afterwards.
    floor : the least residual (root-mean-square) that means anything; a friction band within it
        is not called present.

    Returns
    -------
    None where the samples do not carry the further unknowns or the fit does not converge.
    """
    pole = complex(viscous.poles[0])
    if t.size <= _UNKNOWNS + 1 or pole.imag <= 0:
        return None
    direction = -1.0 if falling else 1.0

    def columns(p: Array, at: Array) -> Array:
        return _columns(at, turning=p[0], decay=p[1], omega_d=p[2], direction=direction)

    def project(p: Array) -> tuple[Array, Array]:
        X = columns(p, t)
        linear = np.linalg.lstsq(X, y, rcond=None)[0]
        return linear.astype(np.float64), X @ linear - y

    fits = [
        least_squares(
            lambda p: project(p)[1],
            [turning, -pole.real * share, pole.imag],
            method="lm",
            max_nfev=_MAX_EVALUATIONS,
            x_scale=[1 / pole.imag, abs(pole), abs(pole)],
        )
        for share in (_LESS_DAMPING if viscous.rms > _ONE_START * floor else _LESS_DAMPING[:1])
    ]
    best = min(fits, key=lambda fit: fit.cost)
    if not best.success or best.x[2] <= 0:
        return None
    linear, residual = project(best.x)
    dof = t.size - _UNKNOWNS
    angle = best.x[2] * (t[-1] - t[0]) / (t.size - 1)
    variance = max(float(residual @ residual) / dof, floor**2) * colour(residual, angle=angle)
    gained = viscous.rms**2 * t.size - float(residual @ residual)
    full = np.column_stack([_per_nonlinear(best.x, t, linear, columns), columns(best.x, t)])
    size = np.maximum(np.linalg.norm(full, axis=0), np.finfo(float).tiny)
    inverse = np.linalg.pinv(np.linalg.qr(full / size, mode="r")) / size[:, None]
    covariance = variance * (inverse @ inverse.T)
    decay, omega_d = float(best.x[1]), float(best.x[2])
    omega_n = float(np.hypot(decay, omega_d))
    per_pole = np.array([omega_d**2, -decay * omega_d]) / omega_n**3  # of zeta = decay / omega_n
    drop, statistic = float(linear[3]), max(gained / variance, 0.0)
    test = FrictionTest(
        f_statistic=statistic,
        threshold=THRESHOLD,
        present=statistic > THRESHOLD and drop > floor,
        drop=drop,
        drop_std=float(np.sqrt(covariance[6, 6])),
        zeta=decay / omega_n,
        zeta_std=float(np.sqrt(per_pole @ covariance[1:3, 1:3] @ per_pole)),
    )
    return FrictionFit(test=test, model=lambda at: columns(best.x, at) @ linear)


def _columns(t: Array, *, turning: float, decay: float, omega_d: float, direction: float) -> Array:
    """Return what rest point, drift, amplitude at `turning` and friction band d multiply, (n, 4).

    `direction` is the sign of the velocity in the half cycle after `turning`.
    """
    half = np.pi / omega_d
    k = np.floor((t - turning) / half)  # half cycles; negative before the turning point
    tau = t - turning - k * half
    swing = np.exp(np.clip(-decay * tau, -_MOST_LOSS, _MOST_LOSS)) * (
        np.cos(omega_d * tau) + decay / omega_d * np.sin(omega_d * tau)
    )
    loss = np.clip(decay * half, -_MOST_LOSS, _MOST_LOSS)  # rho = exp(-loss)
    rho, lost = np.exp(-loss), np.clip(-loss * k, -_MOST_LOSS, _MOST_LOSS)
    # (1 - rho^k) / (1 - rho), which is k without viscous damping
    geometric = np.expm1(lost) / np.expm1(-loss) if loss else k
    sign = np.where(k % 2 == 0, 1.0, -1.0)
    amplitude = sign * np.exp(lost) * swing
    friction = direction * sign * ((1 + (1 + rho) * geometric) * swing - 1)
    return np.column_stack([np.ones_like(t), t - turning, amplitude, friction])


def _per_nonlinear(
    p: Array, t: Array, linear: Array, columns: Callable[[Array, Array], Array]
) -> Array:
    """Return the model's derivatives by the three nonlinear unknowns (n, 3), numerically."""
    steps = 1e-6 * np.array([1 / p[2], p[2], p[2]])
    return np.column_stack(
        [
            (columns(p + step, t) - columns(p - step, t)) @ linear / (2 * step.sum())
            for step in np.diag(steps)
        ]
    )
