"""The laws of the effects, written in a little TeX, as mathematics."""

import re

from pipeline.report.math.tree import Math, Term, dot, fraction, parens, power, row, sub

_TOKEN = re.compile(r"\\[a-zA-Z]+|\\.|\d+(?:\.\d+)?|[^\s]")
_GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "zeta": "ζ", "mu": "μ", "omega": "ω",
    "tau": "τ", "theta": "θ", "phi": "φ", "lambda": "λ", "rho": "ρ", "sigma": "σ", "pi": "π",
    "Gamma": "Γ", "Phi": "Φ",
}  # fmt: skip
_SIGNS = {
    "le": "≤", "ge": "≥", "ne": "≠", "to": "→", "cdot": "·", "approx": "≈", "infty": "∞",
}  # fmt: skip
_THIN, _WIDE, _SPACE = "\u2009", "\u2003", "\u00a0"
_SPACES = {"quad": _WIDE, "qquad": _WIDE, ",": _THIN, ";": _THIN, " ": _SPACE}
_UPRIGHT = frozenset(("sin", "cos", "tan", "exp", "log", "max", "min", "sign"))


def from_tex(text: str) -> Math:
    r"""Return a formula: letters, scripts, brackets, `\frac`, `\dot`, `\text`, Greek, relations.

    A command that is not known stands by its name, so that nothing is lost.
    """
    texts: list[str] = []

    def keep(match: re.Match[str]) -> str:
        texts.append(match[1])
        return f"\\text{{{len(texts) - 1}}}"

    tokens = _TOKEN.findall(re.sub(r"\\text\{([^}]*)\}", keep, text))
    return row(*_Reader(tokens, texts).terms())


class _Reader:
    """Reads tokens from left to right."""

    def __init__(self, tokens: list[str], texts: list[str]) -> None:
        self._tokens, self._texts, self._at = tokens, texts, 0

    def terms(self, *, until: str = "") -> list[Term]:
        """Return the terms up to a closing token, which is taken off, or the end."""
        found: list[Term] = []
        while (token := self._next()) and token != until:
            if token in "_^" and found:
                script = self._argument()
                found[-1] = sub(found[-1], script) if token == "_" else power(found[-1], script)
            else:
                found += self._term(token)
        return found

    def _next(self) -> str:
        self._at += 1
        return self._tokens[self._at - 1] if self._at <= len(self._tokens) else ""

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _argument(self) -> Term:
        found = self._term(self._next())
        return found[0] if len(found) == 1 else row(*found)

    def _term(self, token: str) -> list[Term]:
        if token == "{":
            return [row(*self.terms(until="}"))]
        if token == "(":
            return [parens(*self.terms(until=")"))]
        if not token.startswith("\\"):
            return ["−" if token == "-" else token]
        name = token[1:]
        if name in ("dot", "ddot"):
            return [dot(self._argument(), order=len(name) - 2)]
        if name == "frac":
            return [fraction(self._argument(), self._argument())]
        if name == "left":  # our brackets grow by themselves
            return self._term(self._next())
        if name == "right":
            return []
        if name == "text":
            self._next()
            words = self._texts[int(self._next())]
            self._next()
            return [words.replace(" ", _SPACE)]
        if name == "operatorname":
            return self._function("".join(t for t in _leaves(self._argument())))
        if name in _UPRIGHT:
            return self._function(name)
        return [(_GREEK | _SIGNS | _SPACES).get(name, name)]

    def _function(self, name: str) -> list[Term]:
        return [_THIN, name] if self._peek() in ("(", "\\left") else [_THIN, name, _THIN]


def _leaves(term: Term) -> list[str]:
    if isinstance(term, str):
        return [term]
    return [leaf for part in term.parts for leaf in _leaves(part)]
