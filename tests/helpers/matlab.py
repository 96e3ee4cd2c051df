"""Run the few MATLAB commands that a report prints, with numpy and python-control."""

import re
from collections.abc import Callable
from typing import Any

import control
import numpy as np
from scipy.linalg import expm

_TOKEN = re.compile(r"\s*(\d+\.?\d*(?:e[+-]?\d+)?i?|[A-Za-z_]\w*|[-+*/\\();,=:\[\]])")
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "diag": lambda v: np.diag(np.ravel(v)),
    "kron": np.kron,
    "eye": lambda n: np.eye(_whole(n)),
    "zeros": lambda rows, columns: np.zeros((_whole(rows), _whole(columns))),
    "expm": expm,
    "exp": np.exp,
    "dlqr": lambda *system: control.dlqr(*system)[0],
    "place": lambda A, B, p: control.place(A, B, np.ravel(p)),
    "acker": lambda A, B, p: control.acker(A, B, np.ravel(p)),
    "ss": lambda A, B, C, D, T: control.ss(A, B, C, D, float(np.squeeze(T))),
    "feedback": lambda one, loop: control.feedback(control.ss([], [], [], one, loop.dt), loop),
    "norm": lambda system, _: _peak(system),
    "allmargin": lambda loop: loop,
}


def run_matlab(code: str) -> dict[str, Any]:
    """Return the variables after the commands; `allmargin` returns its loop.

    Every value is a matrix, as in MATLAB. Errors in the code raise an exception.
    """
    code = re.sub(r"%.*", "", code).replace("...\n", " ")
    variables: dict[str, Any] = {"inf": np.inf}
    for statement in re.split(r"\n|;\s*$", code, flags=re.MULTILINE):
        if statement.strip():
            target, _, expression = statement.partition("=")
            value = _Reader(expression, variables).whole()
            place = re.fullmatch(r"(\w+)\((\d+)\)", target.strip())
            if place:
                np.ravel(variables[place[1]])[int(place[2]) - 1] = np.squeeze(value)
            else:
                assert re.fullmatch(r"\w+", target.strip()), statement
                variables[target.strip()] = value
    return variables


def _peak(system: Any) -> float:
    """Return the largest gain, on a grid that is fine enough for four digits."""
    omega = np.geomspace(1e-3, np.pi / system.dt, 20_000)
    return float(np.abs(response(system, np.exp(1j * omega * system.dt))).max())


def response(system: Any, z: Any) -> Any:
    """Return the value of a transfer function with one input and output at each z."""
    resolved = np.linalg.solve(
        np.reshape(z, (-1, 1, 1)) * np.eye(len(system.A)) - system.A, system.B
    )
    return (system.C @ resolved + system.D)[:, 0, 0]


def _whole(value: Any) -> int:
    return int(np.squeeze(value))


class _Reader:
    """A reader of one expression: sums of products of matrices, calls, indices and ranges."""

    def __init__(self, text: str, variables: dict[str, Any]) -> None:
        self.text, self.at, self.variables = text, 0, variables

    def whole(self) -> Any:
        """Return the value of the whole text."""
        value = self.sum()
        assert not self.text[self.at :].strip(" ;"), self.text[self.at :]
        return value

    def next(self) -> str:
        """Return the next token without taking it."""
        match = _TOKEN.match(self.text, self.at)
        return match[1] if match else ""

    def take(self, *expected: str) -> str:
        """Take the next token, which must be one of the expected ones."""
        match = _TOKEN.match(self.text, self.at)
        assert match, self.text[self.at :]
        assert not expected or match[1] in expected, (expected, self.text[self.at :])
        self.at = match.end()
        return match[1]

    def sum(self, *, in_brackets: bool = False) -> Any:
        """Return a sum of products."""
        value = self.product()
        while self.next() in ("+", "-"):
            # Between brackets, "1 -2" are two numbers and "1 - 2" is one.
            if in_brackets and re.match(r"\s+[-+]\S", self.text[self.at :]):
                break
            value = value + self.product() if self.take() == "+" else value - self.product()
        return value

    def product(self) -> Any:
        """Return a product, with its sign."""
        if self.next() == "-":
            self.take()
            return -self.product()
        value = self.atom()
        while self.next() in ("*", "/", "\\"):
            value = _combined(value, self.take(), self.atom())
        return value

    def atom(self) -> Any:
        """Return a number, a matrix, a variable, a call, or a sum in brackets."""
        token = self.take()
        if token == "(":
            value = self.sum()
            self.take(")")
            return value
        if token == "[":
            return self.matrix()
        if token[0].isdigit():
            number = complex(token[:-1] + "j") if token.endswith("i") else float(token)
            return np.array([[number]])
        if not self.text.startswith("(", self.at):
            return self.variables[token]
        self.take("(")
        matrix = self.variables.get(token)
        arguments = [self.argument(index=matrix is not None)]
        while self.take(",", ")") == ",":
            arguments.append(self.argument(index=matrix is not None))
        return _FUNCTIONS[token](*arguments) if matrix is None else matrix[np.ix_(*arguments)]

    def argument(self, *, index: bool) -> Any:
        """Return an argument of a function, or the rows or columns that an index selects."""
        value = self.sum()
        if not index:
            return value
        last = value
        if self.next() == ":":
            self.take()
            last = self.sum()
        return np.arange(_whole(value) - 1, _whole(last))

    def matrix(self) -> Any:
        """Return the matrix whose opening bracket was taken."""
        rows: list[list[Any]] = [[]]
        while self.next() != "]":
            if self.next() == ";":
                self.take()
                rows.append([])
            elif self.next() == ",":
                self.take()
            else:
                rows[-1].append(self.sum(in_brackets=True))
        self.take("]")
        return np.block([row for row in rows if row])


def _combined(left: Any, operator: str, right: Any) -> Any:
    if operator == "\\":
        return np.linalg.solve(left, right)
    if operator == "/":
        if np.size(right) == 1:
            return left / np.squeeze(right)
        return np.linalg.solve(right.T, np.atleast_2d(left).T).T
    return left * right if 1 in (np.size(left), np.size(right)) else left @ right
