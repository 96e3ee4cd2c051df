"""The parameters of a model as one vector: logarithms, or scaled values if the sign may change."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, Effect, EffectTerm, PlaceScales, chain_scales
from pipeline.plant.simulator.tables import Cart, Tables

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
        low, high = [np.full(self.base_size, -np.inf)], [np.full(self.base_size, np.inf)]
        for c in self.effects:
            for p, scale in zip(c.effect.parameters, c.scales, strict=True):
                top = min(p.upper, 1e4)
                if p.signed:
                    low.append(np.array([-top]))
                    high.append(np.array([top]))
                else:
                    low.append(np.array([np.log(max(p.lower, _SMALLEST) * scale)]))
                    high.append(np.array([np.log(top * scale)]))
        return np.concatenate(low), np.concatenate(high)

    def steps(self) -> Array:
        """Return the step of each parameter for finite differences."""
        steps = [np.full(self.base_size, 1e-4)]
        for c in self.effects:
            # Contacts respond irregularly to small changes, so they need larger steps.
            coarse = 5.0 if c.effect.contact else 1.0
            steps.append(
                coarse * np.array([2e-4 if p.signed else 1e-3 for p in c.effect.parameters])
            )
        return np.concatenate(steps)

    def largest_step(self) -> Array:
        """Return the largest step of each parameter in one iteration."""
        reach = [np.full(self.base_size, 0.3)]
        for c in self.effects:
            reach.append(np.array([1.0 if p.signed else p.reach for p in c.effect.parameters]))
        return np.concatenate(reach)

    def physical_derivative(self, theta: Array) -> Array:
        """Return d(parameter)/d(coordinate) for the effects' parameters; 1 for the chain's."""
        out = [np.ones(self.base_size)]
        for index, c in enumerate(self.effects):
            values = c.values(theta[self.span(index)])
            out.append(
                np.array(
                    [
                        scale if p.signed else abs(value)
                        for p, scale, value in zip(
                            c.effect.parameters, c.scales, values, strict=True
                        )
                    ]
                )
            )
        return np.concatenate(out)


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
