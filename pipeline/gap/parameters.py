"""The parameters of a model and of one run, and how a run depends on them.

The nuisance parameters of a run are:

- The states of the carts at its start, and at the start of each further piece.
- The states of hidden masses, but only if the carts already move.
- The encoder zeros.
- A factor on the dry friction of each cart, because dry friction varies between runs.

They enter the residual almost linearly. So a QR factorisation of each run eliminates them, which
leaves a small problem in the shared parameters (variable projection).

Reference: G. H. Golub, V. Pereyra, Inverse Problems 19 (2003), R1 (separable least squares).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.runs import GapRun
from pipeline.plant.chain import Chain
from pipeline.plant.effect import (
    AugmentedChain,
    Effect,
    EffectParameter,
    EffectTerm,
    PlaceScales,
    chain_scales,
)
from pipeline.plant.simulator import sensitivity
from pipeline.plant.simulator.kernel import StartState, simulate
from pipeline.plant.simulator.tables import DRY, Cart, Tables

# ------------------------------------------------------- the parameters of a model as one vector

_SMALLEST = 1e-7  # share of a parameter's scale; a smaller effect counts as absent


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An effect at a place, with the signs and typical sizes of its parameters."""

    effect: Effect
    place: int
    signs: tuple[float, ...]
    scales: tuple[float, ...]

    @property
    def key(self) -> tuple[str, int]:
        """The effect and its place."""
        return self.effect.key, self.place

    def values(self, coordinates: Array) -> list[float]:
        """Return the parameter values for the effect's part of the vector."""
        return [
            float(x) * scale if p.signed else sign * float(np.exp(x))
            for p, x, sign, scale in zip(
                self.effect.parameters, coordinates, self.signs, self.scales, strict=True
            )
        ]

    def coordinates(self, values: Sequence[float]) -> Array:
        """Return the effect's part of the vector for the given parameter values."""
        return np.array(
            [
                v / scale if p.signed else np.log(max(abs(v), _SMALLEST * scale))
                for p, v, scale in zip(self.effect.parameters, values, self.scales, strict=True)
            ]
        )


@dataclass(frozen=True, kw_only=True)
class Structure:
    """The springs and effects of a model, which define the parameter vector.

    The vector holds log m, log c and log k of the existing springs (for one cart, log of their
    sum). Each effect's parameters follow: log |p| if the sign is known, otherwise p over its scale.
    """

    springs: tuple[bool, ...]
    effects: tuple[Candidate, ...] = ()

    @cached_property
    def n(self) -> int:
        """The number of carts."""
        return len(self.springs) - 1

    @cached_property
    def rows(self) -> tuple[int, ...]:
        """The springs whose stiffness is a free parameter, as rows of the spring table."""
        present = tuple(j for j, there in enumerate(self.springs) if there)
        return present[:1] if self.n == 1 else present

    @cached_property
    def base_size(self) -> int:
        """The number of parameters of the linear chain."""
        return 2 * self.n + len(self.rows)

    @cached_property
    def dry(self) -> tuple[bool, ...]:
        """Whether dry friction acts on each cart (n,)."""
        places = {c.place for c in self.effects if c.effect.dry}
        return tuple(i + 1 in places for i in range(self.n))

    @cached_property
    def many_rests(self) -> bool:
        """Whether some cart may rest away from the equilibrium of its springs."""
        return any(c.effect.many_rests for c in self.effects)

    @cached_property
    def has_contact(self) -> bool:
        """Whether some effect has a contact, in which bodies meet."""
        return any(c.effect.contact for c in self.effects)

    @cached_property
    def has_play(self) -> bool:
        """Whether some effect lets the motor lose contact with cart 1."""
        return any(c.effect.has_play for c in self.effects)

    @cached_property
    def hidden(self) -> tuple[int, ...]:
        """The indices of the carts with a hidden mass."""
        return tuple(sorted(c.place - 1 for c in self.effects if c.effect.hides_mass))

    def span(self, index: int) -> slice:
        """Return the slice of the vector with an effect's parameters."""
        start = self.base_size + sum(len(c.effect.parameters) for c in self.effects[:index])
        return slice(start, start + len(self.effects[index].effect.parameters))

    def with_effect(self, candidate: Candidate) -> "Structure":
        """Return the structure with one more effect."""
        return Structure(springs=self.springs, effects=(*self.effects, candidate))

    def without(self, *indices: int) -> "Structure":
        """Return the structure without some of its effects, given by index."""
        kept = tuple(c for i, c in enumerate(self.effects) if i not in indices)
        return Structure(springs=self.springs, effects=kept)

    @cached_property
    def parameters(self) -> tuple[tuple[Candidate, EffectParameter, float], ...]:
        """The effects' parameters in the order of the vector, each with its effect and scale."""
        return tuple(
            (c, p, scale)
            for c in self.effects
            for p, scale in zip(c.effect.parameters, c.scales, strict=True)
        )

    def friction_direction(self, i: int) -> Array:
        """Return the direction of the vector along which the dry friction of cart i grows."""
        grows = [
            float(c.effect.place == "cart" and c.place == i + 1 and column in DRY)
            for c in self.effects
            for column in c.effect.columns(dict.fromkeys(c.effect.names, 1.0))
        ]
        return np.array([0.0] * self.base_size + grows)

    # ------------------------------------------------------------ the vector

    def chain(self, theta: Array) -> Chain:
        """Return the linear chain that a vector describes."""
        n = self.n
        k = np.zeros(n + 1)
        k[list(self.rows)] = np.exp(theta[2 * n : self.base_size])
        return Chain(m=np.exp(theta[:n]), c=np.exp(theta[n : 2 * n]), k=k)

    def model(self, theta: Array) -> AugmentedChain:
        """Return the chain and the effects that a vector describes."""
        terms = []
        for index, candidate in enumerate(self.effects):
            coordinates = theta[self.span(index)]
            terms.append(
                EffectTerm(
                    effect=candidate.effect,
                    place=candidate.place,
                    values=tuple(candidate.values(coordinates)),
                )
            )
        return AugmentedChain(chain=self.chain(theta), terms=tuple(terms))

    def start(self, chain: Chain, values: Sequence[Sequence[float]] = ()) -> "GapModel":
        """Return the model with the given chain and parameter values of the effects."""
        tiny = 1e-3 * np.sqrt(chain.m * np.maximum(np.diag(chain.stiffness), 1e-12 * chain.m))
        parts = [np.log(chain.m), np.log(np.maximum(chain.c, tiny))]
        k = chain.k[list(self.rows)] if self.n > 1 else chain.k.sum(keepdims=True)[: len(self.rows)]
        parts.append(np.log(np.maximum(k, 1e-4 * chain.k.max())))
        parts += [
            candidate.coordinates(value)
            for candidate, value in zip(self.effects, values, strict=True)
        ]
        return GapModel(structure=self, theta=np.concatenate(parts))

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper bounds of the vector."""
        low, high = [-np.inf] * self.base_size, [np.inf] * self.base_size
        for _, p, scale in self.parameters:
            top = min(p.upper, 1e4)
            low.append(-top if p.signed else np.log(max(p.lower, _SMALLEST) * scale))
            high.append(top if p.signed else np.log(top * scale))
        return np.array(low), np.array(high)

    def steps(self) -> Array:
        """Return the step of each parameter for finite differences."""
        # Contacts respond irregularly to small changes, so they need larger steps.
        own = [
            (5.0 if c.effect.contact else 1.0) * (2e-4 if p.signed else 1e-3)
            for c, p, _ in self.parameters
        ]
        return np.array([1e-4] * self.base_size + own)

    def largest_step(self) -> Array:
        """Return the largest step of each parameter in one iteration."""
        own = [1.0 if p.signed else p.reach for _, p, _ in self.parameters]
        return np.array([0.3] * self.base_size + own)

    def physical_derivative(self, theta: Array) -> Array:
        """Return d(parameter)/d(coordinate) for the effects' parameters; 1 for the chain's."""
        values = [value for term in self.model(theta).terms for value in term.values]
        own = [
            scale if p.signed else abs(value)
            for (_, p, scale), value in zip(self.parameters, values, strict=True)
        ]
        return np.array([1.0] * self.base_size + own)


@dataclass(frozen=True, kw_only=True, eq=False)
class GapModel:
    """A structure with its vector `theta` (size,), which is the start or the result of a fit."""

    structure: Structure
    theta: Array

    @property
    def terms(self) -> tuple[EffectTerm, ...]:
        """The effects with their values, in the structure's order."""
        return self.structure.model(self.theta).terms

    @cached_property
    def tables(self) -> Tables:
        """The model as the simulator reads it."""
        return self.structure.model(self.theta).tables()

    @cached_property
    def varied(self) -> "tuple[GapModel, ...]":
        """The models with one parameter changed by its step for finite differences."""
        thetas = self.theta + np.diag(self.structure.steps())
        return tuple(GapModel(structure=self.structure, theta=theta) for theta in thetas)

    @cached_property
    def visible(self) -> bool:
        """Whether all hidden masses are slow enough not to move rigidly with their carts."""
        cart = self.tables.cart
        hidden = cart[:, Cart.EXTRA_MODE_MASS] > 0.0
        if not hidden.any():
            return True
        of_cart = np.diag(self.structure.chain(self.theta).stiffness) / cart[:, Cart.MASS]
        rate = cart[hidden, Cart.EXTRA_MODE_STIFFNESS] / cart[hidden, Cart.EXTRA_MODE_MASS]
        # A hidden mass with over 20 times the frequency of its cart moves with the cart.
        return bool(np.all((of_cart[hidden] == 0.0) | (rate < 20.0**2 * of_cart[hidden])))

    def with_effect(self, candidate: Candidate, values: Sequence[float]) -> "GapModel":
        """Return the model with one more effect at the given parameter values."""
        return GapModel(
            structure=self.structure.with_effect(candidate),
            theta=np.concatenate([self.theta, candidate.coordinates(values)]),
        )

    def without(self, *indices: int) -> "GapModel":
        """Return the model without some of its effects; all other parameters keep their values."""
        spans = [np.r_[self.structure.span(index)] for index in indices]
        return GapModel(
            structure=self.structure.without(*indices),
            theta=np.delete(self.theta, np.concatenate(spans)),
        )


# ------------------------------------------------------------ typical sizes on this bench


def bench_scales(
    runs: Sequence[GapRun], chain: Chain, *, effect: Effect, place: int
) -> PlaceScales:
    """Return the typical sizes of parameters at one place, from records and the linear model."""
    n = chain.n
    size = n if effect.place != "spring" else n + 1
    position, velocity = np.full(size + 1, 1e-12), np.full(size + 1, 1e-12)
    level, sample_time = 1e-12, np.inf
    for run in runs:
        x = run.by_cart(run.y, run.zero)
        if effect.place == "spring":
            x = np.vstack([x, np.zeros(run.t.size)]) - np.vstack([np.zeros(run.t.size), x])
        half = max(1, round(0.02 / run.record.sample_time))
        speed = (x[:, 2 * half :] - x[:, : -2 * half]) / (run.t[2 * half :] - run.t[: -2 * half])
        position[: len(x)] = np.maximum(position[: len(x)], np.abs(x).max(axis=1))
        velocity[: len(x)] = np.maximum(velocity[: len(x)], np.abs(speed).max(axis=1))
        level = max(level, float(np.abs(run.command).max()))
        sample_time = min(sample_time, run.record.sample_time)
    # Time constants of a drive are some milliseconds, whatever the sample time.
    return chain_scales(
        chain,
        place=effect.place,
        at=place,
        largest=(position, velocity),
        input=level,
        sample_time=max(sample_time, 0.005),
    )


# ------------------------------ one run: nuisance parameters, simulation, contribution to a step

_START_STEP = 1e-3  # step for numerical derivatives, relative to swing or friction
_HOME = 0.1  # weight of the priors on starts that the data do not determine
_HELD = 1e6  # weight of a velocity that is known to be zero
FACTOR_STEP = 0.3  # largest step of a friction factor
FACTORS = (0.3, 3.0)  # limits of a friction factor
FRICTION_SPREAD = 0.05  # by how much friction is at first assumed to differ between runs, relative


@dataclass(frozen=True, kw_only=True, eq=False)
class Nuisance:
    """The parameters of one run: start states, encoder zeros, friction factors `scatter` (n,).

    The start states `x0` and `v0` (shots, 2 n) are first those of the carts, then those of their
    hidden masses relative to the carts.
    """

    x0: Array
    v0: Array
    zero: Array
    scatter: Array

    @property
    def start(self) -> StartState:
        """The parameters that the simulator needs."""
        return StartState(self.x0, self.v0, self.scatter)


def fresh_nuisance(run: GapRun) -> Nuisance:
    """Return a run's nuisance parameters at their expected values."""
    n = run.zero.size
    free = np.array(run.free)
    hidden = np.zeros((len(run.shots) - 1, n))
    return Nuisance(
        x0=np.hstack([np.where(free, run.shot_x - run.zero, 0.0), hidden]),
        v0=np.hstack([np.where(free, run.shot_v, 0.0), hidden]),
        zero=np.where(free, run.zero, 0.0),
        scatter=np.ones(n),
    )


def simulate_run(model: GapModel, run: GapRun, nuisance: Nuisance) -> Array:
    """Return the simulated readings (rows, samples) of one run, including the encoder zeros."""
    y, _ = _simulate_variants([model], run, [nuisance.start])
    return y[0] + nuisance.zero[list(run.rows)][:, None]


def _simulate_variants(
    models: Sequence[GapModel],
    run: GapRun,
    starts: Sequence[StartState],
    *,
    lanes: Sequence[tuple[int, int]] = (),
) -> tuple[Array, Array]:
    """Return readings (b, rows, samples) of one run for b models and starts, without zeros.

    Also return the derivatives (lanes, rows, samples) for the first model. Each of the `lanes`
    names a kind of variable from `pipeline.plant.simulator.sensitivity` and a cart or
    spring, from 0.
    """
    variants = [(model.tables, start) for model, start in zip(models, starts, strict=True)]
    of = np.array(lanes, dtype=np.int64).reshape(-1, 2).T
    y, by = simulate(variants, run.excitation, of=of)
    if len(run.rows) == len(run.free):
        return y, by
    return y[:, list(run.rows)], by[:, list(run.rows)]


# ------------------------------------------------------------------- one run linearised


@dataclass(frozen=True, kw_only=True, eq=False)
class Linear:
    """One run's contribution to a step.

    It holds the equations that remain for the shared parameters, and the factors from which the
    nuisance parameters follow.
    """

    reduced: Array  # (rows, size + 1); R of the shared parameters and the residual
    run_wide: Array  # R of friction factors, zeros, shared parameters and residual
    shots: Array  # (shots, ., .); R of starts, factors and zeros, shared parameters and residual
    layout: "Layout"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which parameters move in a step: those of a run, and possibly the shared ones.

    Each field lists cart indices. A hidden mass has the index of its cart plus n.
    """

    x0: tuple[int, ...]
    v0: tuple[int, ...]
    zero: tuple[int, ...]
    scatter: tuple[int, ...]
    first_v0: bool
    shared: bool


def layout_of(
    structure: Structure, run: GapRun, *, scatter_free: bool, shared: bool = True
) -> Layout:
    """Return the nuisance parameters that a run has in a model of a given structure."""
    free = tuple(i for i, moves in enumerate(run.free) if moves)
    multiple = len(run.shots) > 2
    dry = structure.dry if scatter_free else (False,) * structure.n
    moving = () if run.at_rest else tuple(structure.n + i for i in structure.hidden if i in free)
    return Layout(
        x0=free + moving,
        v0=free + moving if multiple or not run.at_rest else (),
        zero=run.rows if any(structure.springs) else (),
        scatter=tuple(i for i in free if dry[i]),
        first_v0=not run.at_rest,
        shared=shared,
    )


def _by_shot(residual: Array, run: GapRun) -> Array:
    """Return weighted residuals (…, rows, samples), cut into shots (…, shots, rows * longest).

    Shorter shots are padded with zeros.
    """
    residual = residual * run.weight
    if len(run.shots) == 2:
        return residual.reshape(*residual.shape[:-2], 1, -1)
    counts = np.diff(run.shots)
    longest = int(counts.max())
    out = np.zeros((*residual.shape[:-2], len(counts), residual.shape[-2], longest))
    for s, (first, count) in enumerate(zip(run.shots[:-1], counts, strict=True)):
        out[..., s, :, :count] = residual[..., first : first + count]
    return out.reshape(*out.shape[:-2], out.shape[-2] * longest)


def residual_points(run: GapRun) -> float:
    """Return the number of residuals of a run, each counted by its weight."""
    return float((run.thin.weight**2).sum())


def triangle(matrix: Array) -> Array:
    """Return R of the QR factorisation of one matrix or of a stack of matrices.

    A tall matrix is factorised in parts that fit the processor's cache. The results are then
    stacked and factorised again.

    Reference: J. Demmel, L. Grigori, M. Hoemmen, J. Langou, SIAM J. Sci. Comput. 34 (2012), A206.
    """
    *stack, rows, columns = matrix.shape
    # A part has about 400 rows.
    parts = rows // 400
    if parts > 1:
        even = rows // parts * parts
        tall = matrix[..., :even, :].reshape(*stack, parts, even // parts, columns)
        triangles = _r(tall).reshape(*stack, -1, columns)
        matrix = np.concatenate([triangles, matrix[..., even:, :]], axis=-2)
    return _r(matrix)


def _r(matrix: Array) -> Array:
    return np.linalg.qr(matrix, mode="r")  # pyright: ignore[reportReturnType]


def linearise(
    model: GapModel,
    run: GapRun,
    nuisance: Nuisance,
    layout: Layout,
    *,
    inflate: float,
    spread: Array,
) -> Linear:
    """Return a run's residual and its Jacobian, with its nuisance parameters eliminated.

    For the priors, the noise is multiplied by `inflate`, because the model may still be wrong.
    """
    run = run.thin
    columns = columns_of(model, run, nuisance, layout)
    prior = start_prior(layout, run, usual_sizes(model, run), inflate=inflate)
    starts = prior.shape[1]
    shots = _eliminate_starts(_by_shot(columns / run.sigma[:, None], run), prior)
    rest = shots[:, starts:, starts:].reshape(-1, shots.shape[-1] - starts)
    expected = run_prior(layout, run, nuisance, rest.shape[-1], spread=spread, inflate=inflate)
    R, wide = triangle(np.concatenate([rest, expected])), len(expected)
    return Linear(
        reduced=R[wide:, wide:], run_wide=R[:wide], shots=shots[:, :starts], layout=layout
    )


def columns_of(model: GapModel, run: GapRun, nuisance: Nuisance, layout: Layout) -> Array:
    """Return the Jacobian (., rows, samples) of a run, with the residual as last column.

    The columns are starts, friction factors, zeros and shared parameters.
    """
    derive = _differences if model.structure.has_contact else _derivatives
    y, by_nuisance, by_shared = derive(model, run, nuisance, layout)
    residual = run.y - y - nuisance.zero[list(run.rows)][:, None]
    by_zero = np.zeros((len(layout.zero), *residual.shape))
    by_zero[range(len(layout.zero)), [run.rows.index(i) for i in layout.zero]] = 1.0
    return np.concatenate([by_nuisance, by_zero, by_shared, residual[None]])


def _eliminate_starts(points: Array, prior: Array) -> Array:
    """Return R of the QR factorisation of each shot, in which the starts come first.

    `points` is (columns, shots, points), and `prior` on the starts is (shots, starts, starts).
    """
    wide = np.zeros((*prior.shape[:2], points.shape[0]))
    wide[:, :, : prior.shape[1]] = prior
    return triangle(np.concatenate([np.moveaxis(points, 0, -1), wide], axis=1))


def run_prior(
    layout: Layout, run: GapRun, nuisance: Nuisance, columns: int, *, spread: Array, inflate: float
) -> Array:
    """Return the priors on friction factors and zeros, (run-wide parameters, columns)."""
    expected = np.zeros((len(layout.scatter) + len(layout.zero), columns))
    for j, i in enumerate(layout.scatter):
        expected[j, j] = inflate / spread[i]
        expected[j, -1] = (1.0 - nuisance.scatter[i]) * expected[j, j]
    for j, i in enumerate(layout.zero, start=len(layout.scatter)):
        expected[j, j] = inflate / run.zero_std[i]
        expected[j, -1] = (run.zero[i] - nuisance.zero[i]) * expected[j, j]
    return expected


def _derivatives(
    model: GapModel, run: GapRun, nuisance: Nuisance, layout: Layout
) -> tuple[Array, Array, Array]:
    """Return the readings (rows, samples), and two sets of derivatives (., rows, samples).

    The first set belongs to the run's starts and friction factors, the second to the shared
    parameters. For the chain's parameters, derivatives are integrated with the state. For the
    effects' parameters they are finite differences.
    """
    structure, theta = model.structure, model.theta
    lanes = [(sensitivity.BY_POSITION, i) for i in layout.x0] + [
        (sensitivity.BY_VELOCITY, i) for i in layout.v0
    ]
    lanes += [(sensitivity.BY_FRICTION, i) for i in layout.scatter]
    local, steps, models = len(lanes), np.zeros(0), [model]
    if layout.shared:
        lanes += [
            (kind, i)
            for kind in (sensitivity.BY_MASS, sensitivity.BY_DAMPING)
            for i in range(structure.n)
        ]
        lanes += [(sensitivity.BY_STIFFNESS, j) for j in structure.rows]
        steps = structure.steps()[structure.base_size :]
        models += model.varied[structure.base_size :]
    y, by = _simulate_variants(models, run, [nuisance.start] * len(models), lanes=lanes)
    # The derivative by the logarithm of p is p times the derivative by p.
    by[local:] *= np.exp(theta[: len(lanes) - local])[:, None, None]
    by_effects = (y[1:] - y[0]) / steps[:, None, None]
    return y[0], by[:local], np.concatenate([by[local:], by_effects])


def _differences(
    model: GapModel, run: GapRun, nuisance: Nuisance, layout: Layout
) -> tuple[Array, Array, Array]:
    """Return the same as `_derivatives`, but from finite differences alone.

    With contacts the misfit has many narrow minima, and a finite difference averages over them.
    """
    position, velocity = usual_sizes(model, run)
    changes = [
        *(("x0", i, _START_STEP * position[i]) for i in layout.x0),
        *(("v0", i, _START_STEP * velocity[i]) for i in layout.v0),
        *(("scatter", i, _START_STEP) for i in layout.scatter),
    ]
    starts = [nuisance.start]
    for name, i, size in changes:
        values = getattr(nuisance, name).copy()
        values[..., i] += size
        starts.append(replace(nuisance, **{name: values}).start)
    own, varied = len(changes), model.varied if layout.shared else ()
    models = [*[model] * len(starts), *varied]
    starts += [nuisance.start] * len(varied)
    y, _ = _simulate_variants(models, run, starts)
    steps = model.structure.steps() if layout.shared else np.zeros(0)
    divisors = np.append([size for _, _, size in changes], steps)
    by = (y[1:] - y[0]) / divisors[:, None, None]
    return y[0], by[:own], by[own:]


def usual_sizes(model: GapModel, run: GapRun) -> tuple[Array, Array]:
    """Return typical positions and velocities (2 n,) of the carts and their hidden masses."""
    size = np.maximum(run.swing, 1e-9)
    chain = model.structure.chain(model.theta)
    position = np.full(chain.n, size.max())
    position[list(run.rows)] = size
    rate = np.sqrt(np.diag(chain.stiffness) / chain.m)
    return np.tile(position, 2), np.tile(position * np.maximum(rate, 1.0), 2)


def start_prior(
    layout: Layout, run: GapRun, sizes: tuple[Array, Array], *, inflate: float
) -> Array:
    """Return weak priors (shots, starts, starts) on starts that the data do not determine.

    The priors are in units of the swing. If a run starts at rest, its first velocity is held at
    zero.
    """
    position, velocity = sizes
    weight = 1.0 / np.concatenate([position[list(layout.x0)], velocity[list(layout.v0)]])
    prior = np.tile(np.diag(_HOME * inflate * weight), (len(run.shots) - 1, 1, 1))
    # The readings say nothing about the state of a hidden mass.
    known = [np.append(1.0 / std, np.zeros(std.size)) for std in run.start_std]
    known_start = np.concatenate([known[0][list(layout.x0)], known[1][list(layout.v0)]])
    prior[0] += np.diag(inflate * known_start)
    if not layout.first_v0:
        for j in range(len(layout.x0), weight.size):
            prior[0, j, j] = _HELD * weight[j]
    return prior


def nuisance_step(linear: Linear, delta: Array) -> tuple[Array, Array]:
    """Return the step of the nuisance parameters that belongs to one of the shared parameters.

    It has two parts: starts (shots, starts), then friction factors and zeros.
    """
    n_wide, n_starts = linear.run_wide.shape[0], linear.shots.shape[1]
    tail = np.concatenate([-delta, [1.0]])
    wide = np.zeros(0)
    if n_wide:
        wide = np.linalg.solve(linear.run_wide[:, :n_wide], linear.run_wide[:, n_wide:] @ tail)
    right = linear.shots[:, :, n_starts:] @ np.concatenate([-wide, tail])
    starts = np.linalg.solve(linear.shots[:, :, :n_starts], right[..., None])[..., 0]
    return np.asarray(starts, dtype=np.float64), np.asarray(wide, dtype=np.float64)


def move_nuisance(
    layout: Layout, nuisance: Nuisance, step: tuple[Array, Array], scale: float
) -> Nuisance:
    """Return the nuisance parameters after a share `scale` of their step."""
    starts, wide = step
    x0, v0 = nuisance.x0.copy(), nuisance.v0.copy()
    zero, scatter = nuisance.zero.copy(), nuisance.scatter.copy()
    x0[:, list(layout.x0)] += scale * starts[:, : len(layout.x0)]
    if layout.v0:
        change = scale * starts[:, len(layout.x0) :]
        if not layout.first_v0:
            change[0] = 0.0
        v0[:, list(layout.v0)] += change
    factors = wide[: len(layout.scatter)]
    scatter[list(layout.scatter)] += scale * np.clip(factors, -FACTOR_STEP, FACTOR_STEP)
    zero[list(layout.zero)] += scale * wide[len(layout.scatter) :]
    return Nuisance(x0=x0, v0=v0, zero=zero, scatter=np.clip(scatter, *FACTORS))


def run_cost(
    model: GapModel, run: GapRun, nuisance: Nuisance, *, spread: Array
) -> tuple[float, float]:
    """Return the chi-square of a run, and its prior terms."""
    if not model.visible:
        return np.inf, 0.0
    run = run.thin
    residual = _by_shot((run.y - simulate_run(model, run, nuisance)) / run.sigma[:, None], run)
    chi = float((residual**2).sum())
    if not np.isfinite(chi):
        return np.inf, 0.0
    rows = list(run.rows)
    prior = float((((nuisance.zero - run.zero) / run.zero_std)[rows] ** 2).sum())
    dry = np.array(model.structure.dry) & np.array(run.free)
    prior += float((((nuisance.scatter - 1.0) / spread)[dry] ** 2).sum())
    return chi, prior
