"""Write `columns.py`, `generated_forces.py` and `terms.py`, the code made from the effects' laws.

Run it as `python -m pipeline.plant.simulator.codegen`. It needs sympy and ruff, which only
developers have, and no other module imports it. Every law is differentiated symbolically, and
printed for the compiler twice: in the parameters that the simulator's tables hold, and in those of
the prediction-error fit (`FitCoordinates`).
"""

import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import sympy
from sympy.printing.pycode import PythonCodePrinter

from pipeline.output import write_file
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.effect import (
    ContactLaw,
    Effect,
    EffectParameter,
    ForceLaw,
    FrictionLaw,
    HysteresisLaw,
    InputLaw,
)

Expr = Any  # sympy's own annotations are partial

_HEAD = (
    '"""{}\n\n'
    "Made by `python -m pipeline.plant.simulator.codegen` from the laws of the effects.\n"
    '"""\n\n'
)
_MASKS = {"cart": "ON_CARTS", "spring": "ON_SPRINGS", "input": "ON_DRIVE"}
_TABLES = {"cart": "Cart", "spring": "Spring", "input": "Drive"}
_AT = {"cart": "cart[i, {}]", "spring": "spring[j, {}]", "input": "drive[{}]"}
_FUNCTIONS = {
    "abs": sympy.Abs,
    "sign": sympy.sign,
    "exp": sympy.exp,
    "sin": sympy.sin,
    "cos": sympy.cos,
    "min": sympy.Min,
    "max": sympy.Max,
    "hypot": lambda a, b: sympy.sqrt(a**2 + b**2),
    "atan2": sympy.atan2,
    "clip": lambda a, low, high: sympy.Min(sympy.Max(a, low), high),
    "π": sympy.pi,
}
_QUANTITIES = ("x", "v", "d", "rate", "k", "u", "on", "z")


def _symbol(name: str) -> sympy.Symbol:
    return sympy.Symbol(name, real=True)


x, v, d, rate, k, u, on, z = map(_symbol, _QUANTITIES)


class _Printer(PythonCodePrinter):
    """Prints what numba compiles."""

    def __init__(self) -> None:
        super().__init__({"fully_qualified_modules": False})

    def _print_sign(self, e: Expr) -> str:
        return f"(1.0 if {self._print(e.args[0])} > 0.0 else -1.0)"


def code(expr: Expr) -> str:
    """Return an expression as Python."""
    return str(_Printer().doprint(expr))


# ------------------------------------------------------------------- laws as expressions


def parse(text: str, effect: Effect) -> Expr:
    """Return an expression of an effect, in which its parameters' symbols have precedence."""
    names = {name: _symbol(name) for name in _QUANTITIES}
    names |= {p.symbol: _parameter(p.symbol) for p in effect.parameters}
    if effect.growth is not None:
        names |= {name: names.get(name, _parameter(name)) for name in effect.growth.coordinates}
    return sympy.sympify(eval(text, {"__builtins__": {}}, _FUNCTIONS | names))


def _parameter(symbol: str) -> sympy.Symbol:
    return _symbol(f"parameter {symbol}")


def text_of(effect: Effect) -> str:
    """Return the expression of a law, or "" for a law that is built in."""
    match effect.law:
        case (
            ForceLaw(force=text)
            | ContactLaw(force=text)
            | FrictionLaw(size=text)
            | InputLaw(arrives=text)
        ):
            return text
    return ""


def derivative(expr: Expr, by: sympy.Symbol) -> Expr:
    """Return the derivative; at a corner or jump, the derivative beside it."""
    out: Expr = sympy.expand(sympy.diff(expr, by)).replace(
        sympy.DiracDelta, lambda *_: sympy.S.Zero
    )
    for one in (x, v, d, rate, u):
        out = out.subs(one * sympy.sign(one), sympy.Abs(one))
    return sympy.factor_terms(out)


def in_table(expr: Expr, effect: Effect) -> Expr:
    """Return an expression with its parameters read from the tables."""
    places = {_parameter(p.symbol): _cell(effect, p) for p in effect.parameters}
    if effect.place == "spring":
        places[k] = "spring[j, Spring.STIFFNESS]"
    return expr.subs({symbol: sympy.Symbol(cell, real=True) for symbol, cell in places.items()})


def _cell(effect: Effect, parameter: EffectParameter) -> str:
    return _AT[effect.place].format(f"{_TABLES[effect.place]}.{effect.column_name(parameter)}")


def _gate(effect: Effect) -> str:
    """Return the condition under which an effect acts."""
    sizes = [p for p in effect.parameters if p.neutral == 0.0]
    first = _cell(effect, (sizes or effect.parameters)[0])
    if isinstance(effect.law, FrictionLaw) and effect.law.beyond:
        held = in_table(parse(effect.law.at_rest or effect.law.size, effect), effect)
        return f"{code(held)} > {first}"
    return f"{first} != 0.0"


# ------------------------------------------------------------------- the columns


def columns_source(catalogue: Sequence[Effect]) -> str:
    """Return the source of the tables' columns."""
    own = {"cart": ["MASS", "DAMPING"], "spring": ["STIFFNESS"], "input": []}
    neutral: dict[str, float] = {}
    dry = []
    for effect in catalogue:
        for p in effect.own:
            name = effect.column_name(p)
            own[effect.place].append(name)
            if p.neutral:
                neutral[name] = p.neutral
        if effect.dry:
            dry.append(f"Cart.{effect.column_name(effect.own[0])}")
    out = [_HEAD.format("The columns of the simulator's tables."), "from enum import IntEnum\n"]
    for place, what in (("cart", "a cart"), ("spring", "a spring"), ("input", "the drive")):
        out.append(f'\n\nclass {_TABLES[place]}(IntEnum):\n    """The row of {what}."""\n')
        out += [f"    {name} = {number}" for number, name in enumerate(own[place])]
    out.append("\n\n# Columns of dry friction, which may differ by a factor from run to run.")
    out.append(f"DRY = ({', '.join(dry)})")
    out.append("# Values for no effect, in columns where 0 would have an effect.")
    out.append(f"NEUTRAL = {neutral!r}")
    return "\n".join(out) + "\n"


# ------------------------------------------------------------------- the simulator's functions

_SIMULATED = (
    ("cart", False, "cart, i, x, v, u", "cart i"),
    ("spring", False, "spring, j, d, rate", "spring j, beyond its stiffness"),
    ("input", False, "drive, x, v, u, on", "cart 1"),
    ("input", True, "drive, x, v, u, on", "the motor"),
)


def forces_source(catalogue: Sequence[Effect]) -> str:
    """Return the source of the laws."""
    out = [
        _HEAD.format("The laws of the effects, for the compiled simulators."),
        "from math import cos, exp, inf, pi, sin\n",
        "from pipeline.plant.simulator.columns import Cart, Drive, Spring",
        "from pipeline.plant.simulator.compiler import inlined, jit\n",
    ]
    for place, on_motor, arguments, where in _SIMULATED:
        out += _forces(catalogue, place, on_motor, arguments, where)
    for place in ("cart", "spring"):
        out += _matrix(catalogue, place)
    out += _friction(catalogue)
    out += _hysteresis(catalogue)
    out += _contacts(catalogue)
    out += _input(catalogue)
    out += _steps(catalogue)
    return "\n".join(out) + "\n"


def terms_source(catalogue: Sequence[Effect]) -> str:
    """Return the source of the laws in their coordinates, for a model that follows."""
    out = [
        _HEAD.format("The laws of the effects in the coordinates of a fit, with derivatives."),
        "from enum import IntEnum\nfrom math import cos, exp, pi, sin\n",
        "from pipeline.plant.simulator.compiler import jit\n",
        *_followed(catalogue),
    ]
    return "\n".join(out) + "\n"


def _is_linear(effect: Effect) -> bool:
    """Return whether a force belongs to the linear chain's matrices."""
    if not isinstance(effect.law, ForceLaw) or effect.place == "input":
        return False
    force = parse(effect.law.force, effect)
    slopes = [sympy.diff(force, q) for q in (x, v, d, rate)]
    rest = force - sum(s * q for s, q in zip(slopes, (x, v, d, rate), strict=True))
    moving = {x, v, d, rate, u, on}
    return not (sympy.expand(rest).free_symbols or any(s.free_symbols & moving for s in slopes))


def _forces(
    catalogue: Iterable[Effect], place: str, on_motor: bool, arguments: str, where: str
) -> Iterator[str]:
    name = {"cart": "cart", "spring": "spring", "input": "motor" if on_motor else "drive"}[place]
    by_x, by_v = (d, rate) if place == "spring" else (x, v)
    force, slopes = [], []
    for effect in catalogue:
        law = effect.law
        if effect.place != place or not isinstance(law, ForceLaw) or law.on_motor != on_motor:
            continue
        if _is_linear(effect):
            continue
        expr = parse(law.force, effect)
        force += [f"    if {_gate(effect)}:", f"        f += {code(in_table(expr, effect))}"]
        lines = [
            f"        {total} += {code(in_table(slope, effect))}"
            for total, by in (("by_x", by_x), ("by_v", by_v))
            if (slope := derivative(expr, by)) != 0
        ]
        slopes += [f"    if {_gate(effect)}:", *lines] if lines else []
    what = "tension" if place == "spring" else "force"
    yield f"\n@inlined\ndef {name}_force({arguments}):"
    yield f'    """Return the nonlinear {what} of {where}."""\n    f = 0.0'
    yield from force
    yield "    return f\n"
    yield f"\n@inlined\ndef {name}_slopes({arguments}):"
    yield f'    """Return the slopes of `{name}_force` against position and velocity."""'
    yield "    by_x = by_v = 0.0"
    yield from slopes
    yield "    return by_x, by_v\n"


def _matrix(catalogue: Iterable[Effect], place: str) -> Iterator[str]:
    row, by = ("i", (x, v)) if place == "cart" else ("j", (d, rate))
    sign = -1 if place == "cart" else 1
    yield f"\n@inlined\ndef {place}_matrix({place}, {row}):"
    yield f'    """Return the stiffness and damping that linear laws add to a {place}."""'
    yield "    stiffness = damping = 0.0"
    for effect in catalogue:
        if effect.place == place and _is_linear(effect):
            for total, one in zip(("stiffness", "damping"), by, strict=True):
                slope = sign * sympy.diff(parse(text_of(effect), effect), one)
                if slope != 0:
                    yield f"    {total} += {code(in_table(slope, effect))}"
    yield "    return stiffness, damping\n"


def _friction(catalogue: Iterable[Effect]) -> Iterator[str]:
    constant, stribeck, slope = [], [], []
    for effect in catalogue:
        if not isinstance(effect.law, FrictionLaw):
            continue
        size = _own_size(effect, catalogue)
        still, moving = size.as_independent(v, as_Add=True)
        if still != 0:
            constant.append(code(in_table(still, effect)))
        if moving != 0:
            gate = f"    if {_gate(effect)}:"
            stribeck += [gate, f"        size += {code(in_table(moving, effect))}"]
            by_v = in_table(derivative(moving, v), effect)
            slope += [gate, f"        slope += {code(by_v)}"]
    yield "\n@inlined\ndef sliding(cart, i, u):"
    yield '    """Return the part of the dry friction that does not depend on the speed."""'
    yield f"    return {' + '.join(constant)}\n"
    yield "\n@inlined\ndef stribeck(cart, i, v, u):"
    yield '    """Return the part of the dry friction that changes with the speed."""'
    yield "    size = 0.0"
    yield from stribeck
    yield "    return size\n"
    yield "\n@inlined\ndef stribeck_slope(cart, i, v, u):"
    yield '    """Return the derivative of `stribeck`, d/dv."""\n    slope = 0.0'
    yield from slope
    yield "    return slope\n"


def _own_size(effect: Effect, catalogue: Iterable[Effect]) -> Expr:
    """Return the size of a friction, less the size of the friction that it contains."""
    law = effect.law
    assert isinstance(law, FrictionLaw)
    size = parse(law.size, effect)
    if law.beyond:
        within = next(e for e in catalogue if e.key == law.beyond)
        size = size - parse(text_of(within), within)
    return size


def hysteresis(effect: Effect) -> tuple[Expr, Expr, Expr]:
    """Return the force against z, where z tends to at a velocity, and at which pace (1/s)."""
    law = effect.law
    assert isinstance(law, HysteresisLaw)
    rate = parse(law.rate, effect)
    pace = sympy.simplify(-sympy.diff(rate, z))
    target = sympy.simplify(rate.subs(z, 0) / pace).subs(v / sympy.Abs(v), sympy.sign(v))
    return -sympy.diff(parse(law.force, effect), z), target, pace


def _hysteresis(catalogue: Iterable[Effect]) -> Iterator[str]:
    mine = [effect for effect in catalogue if isinstance(effect.law, HysteresisLaw)]
    yield "\n@inlined\ndef hysteresis(cart, i, v):"
    yield '    """Return the largest force of hysteresis, and limit and rate (1/s) of its state."""'
    for effect in mine:
        values = ", ".join(code(in_table(one, effect)) for one in hysteresis(effect))
        yield f"    if {_gate(effect)}:\n        return {values}"
    yield "    return 0.0, 0.0, 0.0\n"
    yield "\n@inlined\ndef hysteresis_slopes(cart, i, v):"
    yield '    """Return the derivatives d/dv of the limit and rate of the state."""'
    for effect in mine:
        slopes = (derivative(one, v) for one in hysteresis(effect)[1:])
        values = ", ".join(code(in_table(one, effect)) for one in slopes)
        yield f"    if {_gate(effect)}:\n        return {values}"
    yield "    return 0.0, 0.0\n"


def _contacts(catalogue: Iterable[Effect]) -> Iterator[str]:
    stops, slacks = [], []
    for effect in catalogue:
        if not isinstance(effect.law, ContactLaw):
            continue
        force, at = parse(effect.law.force, effect), parse(effect.law.past, effect)
        if effect.place == "cart":
            wanted = [-derivative(force, x), -derivative(force, v), at]
        else:
            stiffness = derivative(force, d)
            wanted = [stiffness, at, derivative(stiffness, k)]
        values = ", ".join(code(in_table(one, effect)) for one in wanted)
        mine = stops if effect.place == "cart" else slacks
        mine.append(f"    if {_gate(effect)}:\n        return {values}")
    yield "\n@inlined\ndef end_stop(cart, i):"
    yield '    """Return stiffness, damping and (signed) position of the end stop of cart i."""'
    yield from stops
    yield "    return 0.0, 0.0, 0.0\n"
    yield "\n@inlined\ndef bilinear_spring(spring, j):"
    yield '    """Return extra stiffness of spring j, where it begins, and its d/dk."""'
    yield from slacks
    yield "    return 0.0, 0.0, 0.0\n"


def _input(catalogue: Iterable[Effect]) -> Iterator[str]:
    yield "\n@inlined\ndef shaped_input(drive, u):"
    yield '    """Return the input after dead zone, saturation and similar laws."""'
    for effect in catalogue:
        if isinstance(effect.law, InputLaw):
            yield f"    if {_gate(effect)}:"
            yield f"        u = {code(in_table(parse(effect.law.arrives, effect), effect))}"
    yield "    return u\n"


def _steps(catalogue: Iterable[Effect]) -> Iterator[str]:
    yield "\nON_CARTS, ON_SPRINGS, ON_DRIVE = 1, 2, 4  # flags for the places of smooth forces\n"
    yield "\n@jit\ndef longest_step(cart, spring, drive):"
    yield '    """Return the longest step for the laws, in s, and flags such as `ON_CARTS`."""'
    yield "    longest, smooth = inf, 0"
    loops = {
        "cart": "    for i in range(cart.shape[0]):",
        "spring": "    for j in range(spring.shape[0]):",
    }
    for place in _TABLES:
        indent = "        " if place in loops else "    "
        lines = []
        for effect in catalogue:
            force = isinstance(effect.law, ForceLaw) and not _is_linear(effect)
            step = effect.law.step
            if effect.place != place or not (force or isfinite(step)):
                continue
            lines.append(f"{indent}if {_gate(effect)}:")
            lines += [f"{indent}    longest = min(longest, {step!r})"] if isfinite(step) else []
            lines += [f"{indent}    smooth |= {_MASKS[place]}"] if force else []
        yield from [loops[place], *lines] if place in loops and lines else lines
    yield "    return longest, smooth\n"


# ------------------------------------------------------- the functions of the prediction-error fit


def followed(effect: Effect, catalogue: Iterable[Effect]) -> tuple[Expr, list[sympy.Symbol]]:
    """Return the law in its coordinates, and those."""
    growth = effect.grown
    law = _own_size(effect, catalogue) if isinstance(effect.law, FrictionLaw) else None
    expr = parse(text_of(effect), effect) if law is None else law
    values = {_parameter(s): parse(text, effect) for s, text in growth.parameters.items()}
    # All at once: a coordinate may have the symbol of a parameter.
    expr = sympy.simplify(sympy.expand_trig(expr.subs(values, simultaneous=True)))
    if effect.place == "spring":
        expr = expr.subs({d: x, rate: v})
    return expr, [_parameter(name) for name in growth.coordinates]


def _followed(catalogue: Sequence[Effect]) -> Iterator[str]:
    shapes = [_coefficients(effect, catalogue) for effect in catalogue]
    yield '\nclass EffectKind(IntEnum):\n    """The effects, in the order of the catalogue."""\n'
    yield from (f"    {e.key.upper()} = {i}" for i, e in enumerate(catalogue))
    yield "\n\n# For each kind, the coordinates that are zero without the effect."
    yield f"COEFFICIENTS = {tuple(shapes)!r}"
    on_spring = [e.key for e in catalogue if e.place == "spring"]
    friction = [e.key for e in catalogue if isinstance(e.law, FrictionLaw)]
    bristles = [e.key for e in catalogue if isinstance(e.law, HysteresisLaw)]
    for name, keys in (("ON_SPRING", on_spring), ("FRICTION", friction), ("HYSTERESIS", bristles)):
        yield f"{name} = ({''.join(f'EffectKind.{key.upper()}, ' for key in keys)})"
    sizes = [(isinstance(e.law, HysteresisLaw), len(e.grown.coordinates)) for e in catalogue]
    yield "# Largest count of numbers that `terms` or `settle` write."
    yield f"TERMS = {max(5 + 3 * size if bristle else 4 + size for bristle, size in sizes)}\n"
    yield "\n@jit\ndef terms(kind, p, o, x, v, k, u, on, out):"
    yield '    """Fill `out` with the law of a kind and derivatives; coordinates start at p[o].\n'
    yield "    The derivatives are d/dx, d/dv and d/du, then d/d(coordinate) for each coordinate."
    yield "    `x` and `v` belong to a cart or a spring's stretch; `k` is the spring's stiffness."
    yield '    """'
    branch = "if"
    for effect in catalogue:
        if not isinstance(effect.law, ForceLaw | FrictionLaw | ContactLaw):
            continue
        yield f"    {branch} kind == EffectKind.{effect.key.upper()}:"
        branch = "elif"
        yield from _terms_of(effect, catalogue)
    yield "\n\n@jit\ndef settle(kind, p, o, v, out):"
    yield '    """Fill `out` with `hysteresis`, its slopes, and its derivatives by coordinate."""'
    branch = "if"
    for effect in catalogue:
        if isinstance(effect.law, HysteresisLaw):
            yield f"    {branch} kind == EffectKind.{effect.key.upper()}:"
            branch = "elif"
            yield from _hysteresis_of(effect)


def _hysteresis_of(effect: Effect) -> Iterator[str]:
    coordinates = [_parameter(name) for name in effect.grown.coordinates]
    values = {c: _symbol(f"p[o + {q}]" if q else "p[o]") for q, c in enumerate(coordinates)}
    three = hysteresis(effect)
    wanted = [*three, *(derivative(one, v) for one in three[1:])]
    wanted += [derivative(one, by) for by in coordinates for one in three]
    for i, one in enumerate(wanted):
        yield f"        out[{i}] = {code(one.subs(values))}"


def _terms_of(effect: Effect, catalogue: Sequence[Effect]) -> Iterator[str]:
    expr, coordinates = followed(effect, catalogue)
    values = {c: _symbol(f"p[o + {q}]" if q else "p[o]") for q, c in enumerate(coordinates)}
    wanted = [expr, *(derivative(expr, by) for by in (x, v, u, *coordinates))]
    found: Any = sympy.cse([one.subs(values) for one in wanted], order="canonical")
    shared, wanted = found
    indent = "        "
    for name, value in shared:
        yield f"{indent}{name} = {code(value)}"
    law = effect.law
    if isinstance(law, ContactLaw):
        past = code(parse(law.past, effect).subs(values))
        pushes = "" if law.pulls else f" and ({code(wanted[0])}) * {past} <= 0.0"
        yield f"{indent}if (x - {past}) * {past} > 0.0{pushes}:"
        yield from (f"{indent}    out[{i}] = {code(one)}" for i, one in enumerate(wanted))
        yield f"{indent}else:\n{indent}    out[: {len(wanted)}] = 0.0"
    else:
        yield from (f"{indent}out[{i}] = {code(one)}" for i, one in enumerate(wanted))


def _coefficients(effect: Effect, catalogue: Sequence[Effect]) -> tuple[int, ...]:
    """Return which coordinates a law is proportional to; of one that is built in, the first."""
    if not isinstance(effect.law, ForceLaw | FrictionLaw | ContactLaw):
        return (0,)
    expr, coordinates = followed(effect, catalogue)
    mine: list[sympy.Symbol] = []
    for one in coordinates:
        bends = (sympy.diff(expr, one, other) for other in [*mine, one])
        if all(sympy.simplify(bend) == 0 for bend in bends):
            mine.append(one)
    return tuple(i for i, one in enumerate(coordinates) if one in mine)


# ------------------------------------------------------------------- the files

FOLDER = Path(__file__).parent
GENERATED = {
    "columns.py": columns_source,
    "generated_forces.py": forces_source,
    "terms.py": terms_source,
}


def main() -> None:
    """Write each file."""
    for name, source in GENERATED.items():
        write_file(FOLDER / name, source(CATALOGUE))
    files = [str(FOLDER / name) for name in GENERATED]
    subprocess.run([sys.executable, "-m", "ruff", "format", "--quiet", *files], check=True)


if __name__ == "__main__":
    main()
