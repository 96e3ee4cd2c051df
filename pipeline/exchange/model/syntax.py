"""Expressions in Python's syntax, as C and as MATLAB write them.

The laws of the effects are such expressions (`plant.nonlinear.effects.law`). Here their symbols
have become names of the model: `p.NAME` is a parameter, `x.BODY` and `v.BODY` a position and a
velocity, `z.NAME` a bristle; all other names are local variables.
"""

import ast
from collections.abc import Mapping, Sequence

Symbols = Mapping[str, str]
_FORMS = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub,
)  # fmt: skip


def substitute(text: str, symbols: Symbols) -> str:
    """Return an expression with other names, or expressions, for its symbols."""
    return ast.unparse(_Substitution(symbols).visit(ast.parse(text, mode="eval")))


def in_c(text: str) -> str:
    """Return an expression in C; `sign` and `PI` are defined in the file, all else in math.h."""
    return ast.unparse(_C().visit(ast.parse(text, mode="eval")))


def in_matlab(text: str, *, bodies: Sequence[str], bristles: Sequence[str]) -> str:
    """Return an expression in MATLAB, whose bodies and bristles have numbers in this order."""
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
        """Leave out what a one or a zero, put in for a symbol, has made idle."""
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
    """What the languages have in common: the forms that a law may have, each printed."""

    pi = ""
    functions: Mapping[str, str]

    def generic_visit(self, node: ast.AST) -> ast.AST:
        if not isinstance(node, _FORMS):
            raise _not_known(node)
        return super().generic_visit(node)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Name(self.pi) if node.id == "π" else node

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
            case ast.Name(id=name) if name in self.functions:
                return self._call(name, *given)
        raise _not_known(node)

    def _call(self, name: str, *given: ast.expr) -> ast.expr:
        return ast.Call(ast.Name(self.functions[name]), list(given), [])


class _C(_Printer):
    pi = "PI"
    functions = {
        "abs": "fabs", "min": "fmin", "max": "fmax", "exp": "exp", "sin": "sin", "cos": "cos",
        "sign": "sign", "pow": "pow",
    }  # fmt: skip

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
    pi = "pi"
    functions = {
        name: name for name in ("abs", "min", "max", "exp", "sin", "cos", "sign", "power")
    }  # fmt: skip

    def __init__(self, bodies: Sequence[str], bristles: Sequence[str]) -> None:
        self._order = {"x": bodies, "v": bodies, "z": bristles}

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        of = ast.unparse(node.value)
        if of == "p":
            return node
        return ast.Name(f"{of}({self._order[of].index(node.attr) + 1})")

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        # a^b^c is (a^b)^c here, but a**(b**c) in Python.
        nested = isinstance(node.right, ast.BinOp) and isinstance(node.right.op, ast.Pow)
        if isinstance(node.op, ast.Pow) and nested:
            return self._call("power", self.visit(node.left), self.visit(node.right))
        return self.generic_visit(node)
