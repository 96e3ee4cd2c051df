"""Translate expressions from Python's syntax to C and to MATLAB.

The laws of the effects are such expressions (`plant.law`). Here their symbols are
names of the model: `p.NAME` is a parameter, `x.BODY` a position, `v.BODY` a velocity and `z.NAME` a
bristle of dry friction. All other names are local variables.
"""

import ast
from collections.abc import Mapping, Sequence

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
