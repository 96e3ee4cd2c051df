"""The content of an exported model, for all languages: its parameters, bodies and laws.

Laws are expressions as described in `syntax`, with names such as `p.m1`, `x.cart_1`, `v.motor` and
`z.z1`. `u` is the force of the drive on its body, and `on` is 1 while the drive is powered. In a
spring's law, `d` is the stretch and `rate` its velocity.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import DataError
from pipeline.plant.augmented import SteppedBench, rest_positions
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, EffectTerm, input_steps
from pipeline.plant.export.syntax import substitute
from pipeline.plant.law import (
    BuiltLaw,
    ContactLaw,
    ForceLaw,
    FrictionLaw,
    HysteresisLaw,
    InputLaw,
    names_in,
)
from pipeline.plant.simulator.laws import hysteresis
from pipeline.setup import Units

_PHASE = 0.05  # rad of the fastest oscillation per step, for an error of 1e-4 in its period
_LONGEST = 2e-4  # s
_DIGITS = 10  # as in gap.json


@dataclass(frozen=True)
class Parameter:
    """A number that the user of the model may change."""

    name: str
    value: float
    unit: str
    meaning: str

    @property
    def text(self) -> str:
        """The value as a number that all languages read."""
        return f"{self.value:.{_DIGITS}g}"

    @property
    def label(self) -> str:
        """The unit and the meaning."""
        return f"{self.unit}: {self.meaning}" if self.unit else self.meaning


@dataclass(frozen=True)
class Body:
    """A cart, the motor if its coupling has play, or a hidden mass.

    Attributes
    ----------
    mass : the mass as an expression.
    suffix : ending of the names of the body's states, such as `1` in `x1`.
    start : index (from 0) of the cart whose initial state the body takes.
    """

    name: str
    meaning: str
    suffix: str
    mass: str
    start: int


@dataclass(frozen=True)
class Force:
    """A force on a body, or a part of a spring's tension.

    Attributes
    ----------
    side, depth, rate : expressions that describe a contact, which acts while `depth` has the sign
        of `side`. `rate` is the velocity of `depth`.
    pulls : whether a contact can also pull, not only push.
    """

    title: str
    force: str
    body: str = ""
    side: str = ""
    depth: str = ""
    rate: str = ""
    pulls: bool = True


@dataclass(frozen=True)
class SpringTension:
    """A spring with its stretch and its tension.

    `left` and `right` are the bodies at its ends; "" means a wall.
    """

    meaning: str
    stretch: str
    rate: str
    left: str
    right: str
    tension: tuple[Force, ...]

    @property
    def needs_rate(self) -> bool:
        """Whether a part of the tension is a damper."""
        return any(part.rate or "rate" in names_in(part.force) for part in self.tension)


@dataclass(frozen=True)
class Bristle:
    """A state of dry friction: the bend `z` of a bristle. `force` and `rate` are linear in `z`."""

    name: str
    title: str
    body: str
    force: str
    rate: str

    @property
    def now(self) -> str:
        """The force in terms of the current bend."""
        return substitute(self.force, {"z": f"z.{self.name}"})

    @property
    def rate_at_zero(self) -> str:
        """The rate of the bend while the bristle is straight."""
        return substitute(self.rate, {"z": "0"})

    @property
    def rate_slope(self) -> str:
        """The derivative of the rate with respect to the bend."""
        return f"{substitute(self.rate, {'z': '1'})} - ({self.rate_at_zero})"

    @property
    def most(self) -> str:
        """The derivative of the force with respect to the bend."""
        return substitute(f"({self.force})", {"z": "1"}) + (
            f" - ({substitute(self.force, {'z': '0'})})"
        )


@dataclass(frozen=True, kw_only=True)
class Description:
    """The data of a model for the templates.

    Attributes
    ----------
    links : each hidden mass, with the force on its cart. The opposite force acts on the mass.
    inputs : title and law of each step from the input to the force `u`.
    rest : (n_carts,) rest positions, computed without dry friction.
    sign_reversed : whether the input has the opposite sign in the recordings.
    """

    units: Units
    n: int
    parameters: tuple[Parameter, ...]
    bodies: tuple[Body, ...]
    springs: tuple[SpringTension, ...]
    forces: tuple[Force, ...]
    links: tuple[tuple[str, Force], ...]
    play: tuple[str, str, str] | None  # gap, stiffness, damping; None if there is no play
    frictions: tuple[Force, ...]
    bristles: tuple[Bristle, ...]
    inputs: tuple[tuple[str, str], ...]
    delay: str  # an expression, or ""
    lag: str
    readings: tuple[str, ...]
    rest: tuple[str, ...]
    titles: tuple[str, ...]
    sign_reversed: bool

    @property
    def driven(self) -> str:
        """The body on which the drive acts."""
        return "motor" if self.play else "cart_1"

    @property
    def contacts(self) -> list[Force]:
        """The forces that act only on one side of a position."""
        parts = [*self.forces, *(part for s in self.springs for part in s.tension)]
        return [part for part in parts if part.side]

    @property
    def pushes(self) -> list[Force]:
        """The contacts that cannot pull."""
        return [part for part in self.contacts if not part.pulls]

    @property
    def laws(self) -> list[str]:
        """All expressions of the file except masses and readings."""
        parts = [*self.forces, *(part for s in self.springs for part in s.tension)]
        texts = [part.force for part in (*parts, *self.frictions)]
        texts += [text for bristle in self.bristles for text in (bristle.force, bristle.rate)]
        return texts + [text for _, text in self.inputs]


def describe(
    model: AugmentedChain,
    *,
    units: Units,
    free: Collection[int] | None = None,
    sign_reversed: bool = False,
) -> Description:
    """Return the content of a model for export.

    Parameters
    ----------
    free : the carts that may move, by default all. The parameters of other carts are unknown.
    sign_reversed : whether the input has the opposite sign in the recordings.

    Raises
    ------
    DataError : the motor acts before its logged input, so the model would need future inputs.
    """
    chain, terms = model.chain, model.terms
    _refuse_lead(terms)
    by_law: dict[type, list[EffectTerm]] = {}
    for term in terms:
        by_law.setdefault(type(term.effect.law), []).append(term)
    built = {
        kind: [term for term in by_law.get(BuiltLaw, []) if term.effect.is_built(kind)]
        for kind in ("hidden mass", "play", "delay", "lag", "reading")
    }
    play = None
    for term in built["play"]:
        gap, _, stiffness, damping = _names(term)
        play = gap, stiffness, damping
    free = sorted(range(1, chain.n + 1) if free is None else free)
    gains = {term.place: f"{_names(term)[0]} * " for term in built["reading"]}
    step = Parameter("max_step", _longest_step(model, free), "s", "longest step inside")
    return Description(
        units=units,
        n=chain.n,
        parameters=(*_parameters(chain, terms, units, free), step),
        bodies=_bodies(chain, built, free),
        springs=_springs(chain, terms, free),
        forces=_forces(terms, driven="motor" if play else "cart_1", free=free),
        links=tuple(_link(term) for term in built["hidden mass"]),
        play=play,
        frictions=tuple(
            Force(_title(term), _law(term, term.effect.law.size), f"cart_{term.place}")
            for term in terms
            if isinstance(term.effect.law, FrictionLaw)
        ),
        bristles=tuple(
            Bristle(
                f"z{term.place}",
                _title(term),
                f"cart_{term.place}",
                _law(term, term.effect.law.force),
                _law(term, term.effect.law.rate),
            )
            for term in terms
            if isinstance(term.effect.law, HysteresisLaw)
        ),
        inputs=tuple(
            (_title(term), _law(term, term.effect.law.arrives))
            for term in input_steps(terms)
            if isinstance(term.effect.law, InputLaw)
        ),
        delay=_names(built["delay"][0])[0] if built["delay"] else "",
        lag=_names(built["lag"][0])[0] if built["lag"] else "",
        readings=tuple(f"{gains.get(i, '')}x.cart_{i}" for i in range(1, chain.n + 1)),
        rest=tuple(f"{x + 0.0:.{_DIGITS}g}" for x in rest_positions(model, free=free)),
        titles=tuple(_title(term) for term in terms),
        sign_reversed=sign_reversed,
    )


def _refuse_lead(terms: Sequence[EffectTerm]) -> None:
    """Refuse a model whose motor acts before its logged input.

    Raises
    ------
    DataError : the delay is negative.
    """
    for term in terms:
        if term.effect.is_built("delay") and term.values[0] < 0.0:
            raise DataError(
                f"the drive leads its log by {-term.values[0]:.3g} s, so a model would need future "
                "inputs; shift the input in the data files by this time, then repeat cartlab gap"
            )


def _title(term: EffectTerm) -> str:
    at = f", {term.effect.place} {term.place}" if term.place else ""
    return f"{term.effect.title}{at}"


def _names(term: EffectTerm) -> list[str]:
    """Return the parameters of an effect as expressions, in the effect's order."""
    return [f"p.{_name(term, parameter)}" for parameter in term.effect.names]


def _name(term: EffectTerm, parameter: str) -> str:
    at = f"_{term.place}" if term.place else ""
    return f"{term.effect.key}{at}_{parameter}"


def _law(term: EffectTerm, text: str, **quantities: str) -> str:
    """Return the expression of an effect's law, with the model's names of bodies and states."""
    place = f"cart_{term.place or 1}"
    known = {"x": f"x.{place}", "v": f"v.{place}", **quantities}
    if term.effect.place == "spring":
        known = {"k": f"p.k{term.place}"}
    symbols = (p.symbol for p in term.effect.parameters)
    return substitute(text, known | dict(zip(symbols, _names(term), strict=True)))


def _parameters(
    chain: Chain, terms: Sequence[EffectTerm], units: Units, free: Sequence[int]
) -> list[Parameter]:
    return [
        *(Parameter(f"m{i}", chain.m[i - 1], units.mass, f"mass of cart {i}") for i in free),
        *(Parameter(f"c{i}", chain.c[i - 1], units.damping, f"damping of cart {i}") for i in free),
        *(
            Parameter(f"k{j}", chain.k[j - 1], units.stiffness, f"spring {_between(j, chain.n)}")
            for j in _acting_springs(chain, terms, free)
        ),
        *(
            Parameter(
                _name(term, parameter.name),
                value,
                parameter.unit_text(position=units.position, input=units.input),
                f"{_title(term)}: {parameter.name.replace('_', ' ')}",
            )
            for term in terms
            for parameter, value in zip(term.effect.parameters, term.values, strict=True)
        ),
    ]


def _acting_springs(chain: Chain, terms: Sequence[EffectTerm], free: Sequence[int]) -> list[int]:
    """Return the springs that touch a free cart."""
    changed = {term.place for term in terms if term.effect.place == "spring"}
    there = (j for j, k in enumerate(chain.k, start=1) if k != 0.0 or j in changed)
    return [j for j in there if {j - 1, j} & {*free}]


def _between(j: int, n: int) -> str:
    ends = ["the left wall", *(f"cart {i}" for i in range(1, n + 1)), "the right wall"]
    alone = " (of two springs, their sum)" if n == 1 else ""
    return f"{j}, from {ends[j - 1]} to {ends[j]}{alone}"


def _bodies(
    chain: Chain, built: Mapping[str, list[EffectTerm]], free: Sequence[int]
) -> tuple[Body, ...]:
    carts = [
        Body(f"cart_{i}", f"cart {i}", f"{i}", f"p.m{i}", i - 1)
        if i in free
        else Body(f"cart_{i}", f"cart {i}, held as in all recordings", f"{i}", "inf", i - 1)
        for i in range(1, chain.n + 1)
    ]
    others = []
    for term in built["play"]:
        mass = _names(term)[1]
        # As in cartlab's own simulator, cart 1 keeps at least 2 % of its mass.
        carts[0] = replace(carts[0], mass=f"max(p.m1 - {mass}, 0.02 * p.m1)")
        others.append(Body("motor", "motor, in play with cart 1", "_motor", mass, 0))
    for term in built["hidden mass"]:
        i, mass = term.place, _names(term)[0]
        others.append(Body(f"hidden_{i}", f"hidden mass on cart {i}", f"{i}_hidden", mass, i - 1))
    return (*carts, *others)


def _springs(
    chain: Chain, terms: Sequence[EffectTerm], free: Sequence[int]
) -> tuple[SpringTension, ...]:
    springs = []
    for j in _acting_springs(chain, terms, free):
        here = [t for t in terms if t.effect.place == "spring" and t.place == j]
        left, right = (f"cart_{i}" if 1 <= i <= chain.n else "" for i in (j - 1, j))
        parts = [Force("", f"p.k{j} * d")]
        for term in here:
            law = term.effect.law
            if isinstance(law, ForceLaw | ContactLaw):
                part = Force(_title(term), _law(term, law.force))
                if isinstance(law, ContactLaw):
                    side = _law(term, law.past)
                    part = replace(part, side=side, depth=f"d - {side}", rate="rate")
                parts.append(part)
        stretch, rate = (_difference(letter, left, right) for letter in "xv")
        meaning = _between(j, chain.n)
        springs.append(SpringTension(meaning, stretch, rate, left, right, tuple(parts)))
    return tuple(springs)


def _difference(letter: str, left: str, right: str) -> str:
    """Return the expression right minus left; "" means a wall, which is at zero."""
    if not (left and right):
        return f"{letter}.{right}" if right else f"-{letter}.{left}"
    return f"{letter}.{right} - {letter}.{left}"


def _forces(terms: Sequence[EffectTerm], *, driven: str, free: Sequence[int]) -> tuple[Force, ...]:
    forces = [Force("", f"-p.c{i} * v.cart_{i}", f"cart_{i}") for i in free]
    for term in terms:
        law, body = term.effect.law, f"cart_{term.place or 1}"
        if term.effect.place == "spring":
            continue
        if isinstance(law, ForceLaw):
            body = driven if law.on_motor else body
            moved = {"x": f"x.{body}", "v": f"v.{body}"}
            forces.append(Force(_title(term), _law(term, law.force, **moved), body))
        elif isinstance(law, ContactLaw):
            side = _law(term, law.past)
            depth, rate = f"x.{body} - {side}", f"v.{body}"
            force = _law(term, law.force)
            forces.append(Force(_title(term), force, body, side, depth, rate, law.pulls))
    return tuple(forces)


def _link(term: EffectTerm) -> tuple[str, Force]:
    """Return the hidden mass of an effect, and the force on the cart to which it is attached."""
    cart, hidden = f"cart_{term.place}", f"hidden_{term.place}"
    _, k, c = _names(term)
    force = f"{k} * (x.{hidden} - x.{cart}) + {c} * (v.{hidden} - v.{cart})"
    return hidden, Force(_title(term), force, cart)


def _longest_step(model: AugmentedChain, free: Sequence[int]) -> float:
    """Return the longest time step in s.

    In one step, the fastest oscillation advances by a twentieth of a radian; in a contact, by a
    tenth. cartlab's own simulator is of higher order and takes steps four times as long.
    """
    step = 0.25 * SteppedBench(model, free=free).shortest_step
    cart = model.tables().cart
    for i, mass in enumerate(model.chain.m):
        holds, _, pace = hysteresis(cart, i, 1.0)
        if holds > 0.0:
            step = min(step, _PHASE / np.sqrt(holds * pace / mass))
    return float(min(step, _LONGEST))
