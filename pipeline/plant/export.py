"""Describe a model by expressions, and export it to other programs: C, MATLAB and FMU.

The compiled simulator is imported where it is needed, because python-control's system, which is
made from the same description, does without it.
"""

import ast
import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import __version__
from pipeline.errors import DataError
from pipeline.plant import effect
from pipeline.plant.chain import Chain
from pipeline.resources import TEMPLATES
from pipeline.setup import Units

# --------------------------------------------- expressions, from Python's syntax to C and MATLAB
#
# The laws of the effects are such expressions (`plant.effect`). Here their symbols are names of the
# model: `p.NAME` is a parameter, `x.BODY` a position, `v.BODY` a velocity and `z.NAME` a bristle of
# dry friction. All other names are local variables.

Symbols = Mapping[str, str]
_FORMS = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub,
)  # fmt: skip

# Functions allowed in a law. `pow` stands for powers, which have no operator in C.
_MATH = {name: name for name in ("abs", "min", "max", "exp", "sin", "cos", "sign", "pow")}

_IN_C = {"π": "PI", "inf": "INFINITY"}
_IN_MATLAB = {"π": "pi", "inf": "Inf"}


def substitute(text: str, symbols: Symbols) -> str:
    """Replace symbols of an expression by other names or expressions."""
    return ast.unparse(_Substitution(symbols).visit(ast.parse(text, mode="eval")))


def in_c(text: str) -> str:
    """Return an expression in C; `sign` and `PI` must be defined in the file."""
    return ast.unparse(_C().visit(ast.parse(text, mode="eval")))


def in_matlab(text: str, *, bodies: Sequence[str], bristles: Sequence[str]) -> str:
    """Return an expression in MATLAB; bodies and bristles are numbered in the given order."""
    written = ast.unparse(_Matlab(bodies, bristles).visit(ast.parse(text, mode="eval")))
    return written.replace(" ** ", "^")


class _Substitution(ast.NodeTransformer):
    def __init__(self, symbols: Symbols) -> None:
        self._symbols = {name: ast.parse(text, mode="eval") for name, text in symbols.items()}

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self._symbols[node.id].body if node.id in self._symbols else node

    def visit_Call(self, node: ast.Call) -> ast.expr:
        return ast.Call(node.func, [self.visit(one) for one in node.args], [])

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Simplify operations with 0 and 1, which the substitution may have introduced."""
        left, right = self.visit(node.left), self.visit(node.right)
        match node.op, _value(left), _value(right):
            case (ast.Mult(), 0, _) | (ast.Mult(), _, 0):
                return ast.Constant(0)
            case (ast.Mult(), 1, _) | (ast.Add(), 0, _):
                return right
            case (ast.Mult() | ast.Div(), _, 1) | (ast.Add() | ast.Sub(), _, 0):
                return left
        return ast.BinOp(left, node.op, right)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        operand = self.visit(node.operand)
        return operand if _value(operand) == 0 else ast.UnaryOp(node.op, operand)


def _value(node: ast.expr) -> object:
    return node.value if isinstance(node, ast.Constant) else None


def _not_known(node: ast.AST) -> ValueError:
    return ValueError(f"no part of a law: {ast.unparse(node)}")


class _Printer(ast.NodeTransformer):
    """The rules for both languages. They refuse any syntax that laws do not use."""

    def __init__(self, functions: Mapping[str, str], constants: Mapping[str, str]) -> None:
        self._functions, self._constants = functions, constants

    def generic_visit(self, node: ast.AST) -> ast.AST:
        if not isinstance(node, _FORMS):
            raise _not_known(node)
        return super().generic_visit(node)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Name(self._constants.get(node.id, node.id))

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        if not isinstance(node.value, int | float):
            raise _not_known(node)
        return node

    def visit_Call(self, node: ast.Call) -> ast.expr:
        given = [self.visit(one) for one in node.args]
        match node.func:
            case ast.Name(id="clip"):
                value, low, high = given
                return self._call("min", self._call("max", value, low), high)
            case ast.Name(id="min" | "max" as name):
                first, *others = given
                for other in others:
                    first = self._call(name, first, other)
                return first
            case ast.Name(id=name) if name in self._functions:
                return self._call(name, *given)
        raise _not_known(node)

    def _call(self, name: str, *given: ast.expr) -> ast.expr:
        return ast.Call(ast.Name(self._functions[name]), list(given), [])


class _C(_Printer):
    def __init__(self) -> None:
        super().__init__(_MATH | {"abs": "fabs", "min": "fmin", "max": "fmax"}, _IN_C)

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        of = ast.unparse(node.value)
        return ast.Name(f"p->{node.attr}" if of == "p" else f"{of}[{node.attr.upper()}]")

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        super().visit_Constant(node)
        return ast.Constant(float(node.value))  # pyright: ignore[reportArgumentType]

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if isinstance(node.op, ast.Pow):
            return self._call("pow", self.visit(node.left), self.visit(node.right))
        return self.generic_visit(node)


class _Matlab(_Printer):
    def __init__(self, bodies: Sequence[str], bristles: Sequence[str]) -> None:
        super().__init__(_MATH | {"pow": "power"}, _IN_MATLAB)
        self._order = {"x": bodies, "v": bodies, "z": bristles}

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        of = ast.unparse(node.value)
        if of == "p":
            return node
        return ast.Name(f"{of}({self._order[of].index(node.attr) + 1})")

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        # In MATLAB a^b^c means (a^b)^c, in Python a**b**c means a**(b**c).
        nested = isinstance(node.right, ast.BinOp) and isinstance(node.right.op, ast.Pow)
        if isinstance(node.op, ast.Pow) and nested:
            return self._call("pow", self.visit(node.left), self.visit(node.right))
        return self.generic_visit(node)


# ----------------------------------------------------- the content of a model, for all languages
#
# Laws are expressions as described above, with names such as `p.m1`, `x.cart_1`, `v.motor`
# and `z.z1`. `u` is the force of the drive on its body, and `on` is 1 while the drive is powered.
# In a spring's law, `d` is the stretch and `rate` its velocity.

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
        return any(part.rate or "rate" in effect.names_in(part.force) for part in self.tension)


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


class Description:
    """The data of a model for the templates.

    Parameters
    ----------
    free : the carts that may move, by default all. The parameters of other carts are unknown.
    sign_reversed : whether the input has the opposite sign in the recordings.

    Raises
    ------
    DataError : the motor acts before its logged input, so the model would need future inputs.

    Attributes
    ----------
    numbers : the parameters of carts and effects.
    play : gap, stiffness and damping; None if there is no play.
    delay, lag : expressions, or "".
    links : each hidden mass, with the force on its cart. The opposite force acts on the mass.
    inputs : title and law of each step from the input to the force `u`.
    """

    def __init__(
        self,
        model: effect.AugmentedChain,
        *,
        units: Units,
        free: Collection[int] | None = None,
        sign_reversed: bool = False,
    ) -> None:
        chain, terms = model.chain, model.terms
        _refuse_lead(terms)
        built = {
            kind: [term for term in terms if term.effect.is_built(kind)]
            for kind in ("hidden mass", "play", "delay", "lag", "reading")
        }
        play = None
        for term in built["play"]:
            gap, _, stiffness, damping = _names(term)
            play = gap, stiffness, damping
        free = sorted(range(1, chain.n + 1) if free is None else free)
        gains = {term.place: f"{_names(term)[0]} * " for term in built["reading"]}
        self._model, self._free = model, free
        self.units = units
        self.n = chain.n
        self.numbers = _parameters(chain, terms, units, free)
        self.bodies = _bodies(chain, built, free)
        self.springs = _springs(chain, terms, free)
        self.forces = _forces(terms, driven="motor" if play else "cart_1", free=free)
        self.links = tuple(_link(term) for term in built["hidden mass"])
        self.play = play
        self.frictions = tuple(
            Force(_title(term), _law(term, term.effect.law.size), f"cart_{term.place}")
            for term in terms
            if isinstance(term.effect.law, effect.FrictionLaw)
        )
        self.bristles = tuple(
            Bristle(
                f"z{term.place}",
                _title(term),
                f"cart_{term.place}",
                _law(term, term.effect.law.force),
                _law(term, term.effect.law.rate),
            )
            for term in terms
            if isinstance(term.effect.law, effect.HysteresisLaw)
        )
        self.inputs = tuple(
            (_title(term), _law(term, term.effect.law.arrives))
            for term in effect.input_steps(terms)
            if isinstance(term.effect.law, effect.InputLaw)
        )
        self.delay = _names(built["delay"][0])[0] if built["delay"] else ""
        self.lag = _names(built["lag"][0])[0] if built["lag"] else ""
        self.readings = tuple(f"{gains.get(i, '')}x.cart_{i}" for i in range(1, chain.n + 1))
        self.titles = tuple(_title(term) for term in terms)
        self.sign_reversed = sign_reversed

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The `numbers` of the model, and its longest step."""
        longest = _longest_step(self._model, self._free)
        return (*self.numbers, Parameter("max_step", longest, "s", "longest step inside"))

    @cached_property
    def rest(self) -> tuple[str, ...]:
        """The rest positions (n_carts,), computed without dry friction."""
        from pipeline.plant.augmented import rest_positions

        at = rest_positions(self._model, free=self._free)
        return tuple(f"{x + 0.0:.{_DIGITS}g}" for x in at)

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


def _refuse_lead(terms: Sequence[effect.EffectTerm]) -> None:
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


def _title(term: effect.EffectTerm) -> str:
    at = f", {term.effect.place} {term.place}" if term.place else ""
    return f"{term.effect.title}{at}"


def _names(term: effect.EffectTerm) -> list[str]:
    """Return the parameters of an effect as expressions, in the effect's order."""
    return [f"p.{_name(term, parameter)}" for parameter in term.effect.names]


def _name(term: effect.EffectTerm, parameter: str) -> str:
    at = f"_{term.place}" if term.place else ""
    return f"{term.effect.key}{at}_{parameter}"


def _law(term: effect.EffectTerm, text: str, **quantities: str) -> str:
    """Return the expression of an effect's law, with the model's names of bodies and states."""
    place = f"cart_{term.place or 1}"
    known = {"x": f"x.{place}", "v": f"v.{place}", **quantities}
    if term.effect.place == "spring":
        known = {"k": f"p.k{term.place}"}
    symbols = (p.symbol for p in term.effect.parameters)
    return substitute(text, known | dict(zip(symbols, _names(term), strict=True)))


def _parameters(
    chain: Chain, terms: Sequence[effect.EffectTerm], units: Units, free: Sequence[int]
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


def _acting_springs(
    chain: Chain, terms: Sequence[effect.EffectTerm], free: Sequence[int]
) -> list[int]:
    """Return the springs that touch a free cart."""
    changed = {term.place for term in terms if term.effect.place == "spring"}
    there = (j for j, k in enumerate(chain.k, start=1) if k != 0.0 or j in changed)
    return [j for j in there if {j - 1, j} & {*free}]


def _between(j: int, n: int) -> str:
    ends = ["the left wall", *(f"cart {i}" for i in range(1, n + 1)), "the right wall"]
    alone = " (of two springs, their sum)" if n == 1 else ""
    return f"{j}, from {ends[j - 1]} to {ends[j]}{alone}"


def _bodies(
    chain: Chain, built: Mapping[str, list[effect.EffectTerm]], free: Sequence[int]
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
    chain: Chain, terms: Sequence[effect.EffectTerm], free: Sequence[int]
) -> tuple[SpringTension, ...]:
    springs = []
    for j in _acting_springs(chain, terms, free):
        here = [t for t in terms if t.effect.place == "spring" and t.place == j]
        left, right = (f"cart_{i}" if 1 <= i <= chain.n else "" for i in (j - 1, j))
        parts = [Force("", f"p.k{j} * d")]
        for term in here:
            law = term.effect.law
            if isinstance(law, effect.ForceLaw | effect.ContactLaw):
                part = Force(_title(term), _law(term, law.force))
                if isinstance(law, effect.ContactLaw):
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


def _forces(
    terms: Sequence[effect.EffectTerm], *, driven: str, free: Sequence[int]
) -> tuple[Force, ...]:
    forces = [Force("", f"-p.c{i} * v.cart_{i}", f"cart_{i}") for i in free]
    for term in terms:
        law, body = term.effect.law, f"cart_{term.place or 1}"
        if term.effect.place == "spring":
            continue
        if isinstance(law, effect.ForceLaw):
            body = driven if law.on_motor else body
            moved = {"x": f"x.{body}", "v": f"v.{body}"}
            forces.append(Force(_title(term), _law(term, law.force, **moved), body))
        elif isinstance(law, effect.ContactLaw):
            side = _law(term, law.past)
            depth, rate = f"x.{body} - {side}", f"v.{body}"
            force = _law(term, law.force)
            forces.append(Force(_title(term), force, body, side, depth, rate, law.pulls))
    return tuple(forces)


def _link(term: effect.EffectTerm) -> tuple[str, Force]:
    """Return the hidden mass of an effect, and the force on the cart to which it is attached."""
    cart, hidden = f"cart_{term.place}", f"hidden_{term.place}"
    _, k, c = _names(term)
    force = f"{k} * (x.{hidden} - x.{cart}) + {c} * (v.{hidden} - v.{cart})"
    return hidden, Force(_title(term), force, cart)


def _longest_step(model: effect.AugmentedChain, free: Sequence[int]) -> float:
    """Return the longest time step in s.

    In one step, the fastest oscillation advances by a twentieth of a radian; in a contact, by a
    tenth. cartlab's own simulator is of higher order and takes steps four times as long.
    """
    from pipeline.plant.augmented import SteppedBench
    from pipeline.plant.simulator.generated_forces import hysteresis

    step = 0.25 * SteppedBench(model, free=free).shortest_step
    cart = model.tables().cart
    for i, mass in enumerate(model.chain.m):
        holds, _, pace = hysteresis(cart, i, 1.0)
        if holds > 0.0:
            step = min(step, _PHASE / np.sqrt(holds * pace / mass))
    return float(min(step, _LONGEST))


# ---------------------------------------------------------------------- source code

TITLE = f"Carts on springs with the effects that cartlab {__version__} found"

_LETTERS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "²": "^2", "³": "^3", "·": "*"})


def c_sources(description: Description) -> dict[str, str]:
    """Return the texts of `model.h` and `model.c`."""
    return {name: render(name, description, code=in_c) for name in ("model.h", "model.c")}


def matlab_source(description: Description) -> str:
    """Return the text of `model.m`."""
    bodies = [body.name for body in description.bodies]
    bristles = [bristle.name for bristle in description.bristles]
    code = partial(in_matlab, bodies=bodies, bristles=bristles)
    return render("model.m", description, code=code)


def render(
    name: str, description: Description, *, code: Callable[[str], str] = in_c, **more: Any
) -> str:
    """Fill in a template of `templates/model`; `code` translates expressions."""
    # Imported late, because this takes 50 ms.
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES / "model"),
        undefined=jinja2.StrictUndefined,
        autoescape=name.endswith(".xml"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    bodies = [body.name for body in description.bodies]
    number = {name: f"{place}" for place, name in enumerate(bodies, start=1)}
    environment.filters |= {"code": code, "comment": comment, "number": number.__getitem__}
    return environment.get_template(f"{name}.j2").render(
        d=description, title=TITLE, units=description.units, **more
    )


def comment(text: str) -> str:
    """Return a text that is safe in a comment: only ASCII, and nothing that ends the comment."""
    plain = text.translate(_LETTERS).encode("ascii", "replace").decode().replace("\\", "/")
    return plain.replace("/*", "/ *").replace("*/", "* /").replace("??", "? ?")


# --------------------------------------------------------------------- FMI 2.0 for co-simulation
#
# It contains sources and, if there is a compiler, a binary.
#
# Reference: Functional Mock-up Interface for Model Exchange and Co-Simulation, version 2.0.4.

_COMPILERS = ("cc", "gcc", "clang")
_PATIENCE = 120.0  # s; compiling normally takes 0.3 s
# earliest date in a zip file; a fixed date gives the same bytes each time
_EPOCH = (1980, 1, 1, 0, 0, 0)
_LIBRARY = {"linux": "so", "darwin": "dylib", "win32": "dll"}
_SYSTEM = {"linux": "linux", "darwin": "darwin", "win32": "win"}


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A variable in modelDescription.xml; `member` is its name in the C structure."""

    index: int
    name: str
    member: str
    meaning: str
    unit: str
    causality: str
    variability: str = "continuous"
    start: str = ""


def fmu(description: Description) -> tuple[bytes, bool]:
    """Return `model.fmu`, and whether it has a binary for this computer."""
    sources = c_sources(description)
    variables = _variables(description)
    settable = sum(v.causality in ("input", "parameter") for v in variables)
    # The GUID in binary and description must be the same, because tools compare them.
    known = "".join([*sources.values(), *map(repr, variables), __version__])
    guid = f"{{{hashlib.sha256(known.encode()).hexdigest()[:32]}}}"
    values = {"guid": guid, "variables": variables, "settable": settable, "version": __version__}
    sources |= {name: render(name, description, **values) for name in ("fmi2.h", "fmi2.c")}
    files: dict[str, str | bytes] = {
        "modelDescription.xml": render("modelDescription.xml", description, **values),
        **{f"sources/{name}": text for name, text in sources.items()},
    }
    binary = compile_library(sources)
    if binary is not None:
        bits = 64 if sys.maxsize > 2**32 else 32
        system = _SYSTEM[sys.platform]
        files[f"binaries/{system}{bits}/model.{_LIBRARY[sys.platform]}"] = binary
    return _zip(files), binary is not None


def _variables(description: Description) -> list[Variable]:
    units, found = description.units, []

    def add(name: str, member: str, meaning: str, unit: str, causality: str, **more: str) -> None:
        index = len(found) + 1
        found.append(
            Variable(
                index=index, name=name, member=member, meaning=meaning, unit=unit,
                causality=causality, **more,
            )
        )  # fmt: skip

    fixed = {"causality": "parameter", "variability": "fixed"}
    tunable = {"causality": "parameter", "variability": "tunable"}
    sign_note = "; the recordings count it the other way" if description.sign_reversed else ""
    add("u", "u", f"input, constant during a step{sign_note}", units.input, "input", start="0")
    for i, start in enumerate(description.rest, start=1):
        meaning = f"start position of cart {i}"
        add(f"x{i}_start", f"start[{i - 1}]", meaning, units.position, start=start, **fixed)
    for p in description.parameters:
        add(p.name, f"model.p.{p.name}", p.meaning, p.unit, start=p.text, **tunable)
    for i in range(1, description.n + 1):
        add(f"x{i}", f"model.y[{i - 1}]", f"reading of sensor {i}", units.position, "output")
    speed = f"{units.position}/s"
    for at, body in enumerate(description.bodies):
        if at >= description.n:
            meaning = f"position of {body.meaning}"
            add(f"x{body.suffix}", f"model.x[{at}]", meaning, units.position, "local")
        add(f"v{body.suffix}", f"model.v[{at}]", f"velocity of {body.meaning}", speed, "local")
    for at, bristle in enumerate(description.bristles):
        add(bristle.name, f"model.z[{at}]", f"bend, -1 to 1: {bristle.title}", "", "local")
    if description.lag:
        add("u_lag", "model.lagged", "input after the lag", units.input, "local")
    return found


def compile_library(sources: Mapping[str, str]) -> bytes | None:
    """Return the sources compiled to a library for this computer; None if there is no compiler."""
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None or sys.platform not in _LIBRARY:
        return None
    with tempfile.TemporaryDirectory() as name:
        for file, text in sources.items():
            (Path(name) / file).write_text(text, encoding="utf-8")
        library = f"model.{_LIBRARY[sys.platform]}"
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden", "-o", library]
        command = [compiler, *options, "model.c", "fmi2.c", "-lm"]
        try:
            done = subprocess.run(command, cwd=name, capture_output=True, timeout=_PATIENCE)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return (Path(name) / library).read_bytes() if done.returncode == 0 else None


def _zip(files: Mapping[str, str | bytes]) -> bytes:
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()
