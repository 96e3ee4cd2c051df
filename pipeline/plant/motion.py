"""The chain with its effects as an ordinary differential equation, for python-control.

It is built from the laws of the effects. The simulator switches at exact instants, but the
right-hand side given here suits any solver. Two things are approximate:

- Dry friction is set-valued at rest. Here it brakes a slow cart like a damper that would stop it in
  `stop` s, up to the friction's size. So a cart held by friction creeps at force / mass * stop.
- A delay is a Padé approximation of the fourth order, good up to a frequency of about 4 / delay
  (rad/s). See C. Moler, C. Van Loan, SIAM Review 45 (2003), 3-49, section 3, for the exponential.

Without effects, the equation is that of the linear chain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, exp, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import factorial

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant import effect

if TYPE_CHECKING:
    import control


STOP_TIME = 1e-4  # in s; default of the parameter `stop`
_PADE_ORDER = 4

_FUNCTIONS: dict[str, Any] = {
    "__builtins__": {},
    "abs": abs,
    "min": min,
    "max": max,
    "exp": exp,
    "sin": sin,
    "cos": cos,
    "π": pi,
    "sign": lambda a: float((a > 0) - (a < 0)),
    "clip": lambda a, low, high: min(max(a, low), high),
}


@dataclass(frozen=True)
class _Expression:
    """An expression of a law at one place, with its parameters filled in."""

    code: Any
    values: Mapping[str, float]

    def __call__(self, **quantities: float) -> float:
        return float(eval(self.code, _FUNCTIONS, {**self.values, **quantities}))


def _expression(text: str, term: effect.EffectTerm, **more: float) -> _Expression:
    symbols = [p.symbol for p in term.effect.parameters]
    values = dict(zip(symbols, term.values, strict=True))
    return _Expression(compile(text, "<law>", "eval"), {**values, **more})


class EquationsOfMotion:
    """The state and its rate of change.

    Attributes
    ----------
    states : names of the states. First come x1, v1, x2, v2, …, then the states of the effects: `z1`
        of a bristle, `x1_hidden` and `v1_hidden` of a hidden mass, `x_motor` and `v_motor` with
        backlash, `u_lag`, `u_delay_1`, ….
    """

    def __init__(self, model: effect.AugmentedChain) -> None:
        """Read the laws of a model.

        Raises
        ------
        DataError : the motor acts before its logged input; no state model can do that.
        """
        chain, terms = model.chain, model.terms
        self.n = n = chain.n
        self._m, self._c, self._k = chain.m.copy(), chain.c, chain.k
        self.states = [f"{letter}{i + 1}" for i in range(n) for letter in "xv"]
        self.gains = np.ones(n)
        self._forces = [
            (term, _expression(term.effect.law.force, term, **self._spring(term)))
            for term in terms
            if isinstance(term.effect.law, effect.ForceLaw)
        ]
        self._contacts = [
            (
                term,
                _expression(term.effect.law.force, term, **self._spring(term)),
                _expression(term.effect.law.past, term)(),
                term.effect.law.pulls,
            )
            for term in terms
            if isinstance(term.effect.law, effect.ContactLaw)
        ]
        self._frictions = [
            (term.place - 1, _expression(term.effect.law.size, term))
            for term in terms
            if isinstance(term.effect.law, effect.FrictionLaw)
        ]
        self._inputs = [
            _expression(term.effect.law.arrives, term)
            for term in effect.input_steps(terms)
            if isinstance(term.effect.law, effect.InputLaw)
        ]
        self._built: dict[str, list[tuple[effect.EffectTerm, int]]] = {}
        self._delay: tuple[Array, Array, Array, float] | None = None
        for term in terms:
            if isinstance(term.effect.law, effect.BuiltLaw):
                self._add(term, term.effect.law.kind)
        self._bristles = [
            (term.place - 1, _expression(term.effect.law.force, term),
             _expression(term.effect.law.rate, term), len(self.states) + q)
            for q, term in enumerate(
                one for one in terms if isinstance(one.effect.law, effect.HysteresisLaw))
            if isinstance(term.effect.law, effect.HysteresisLaw)
        ]  # fmt: skip
        self.states += [f"z{i + 1}" for i, *_ in self._bristles]

    def _spring(self, term: effect.EffectTerm) -> dict[str, float]:
        return {"k": float(self._k[term.place - 1])} if term.effect.place == "spring" else {}

    def _add(self, term: effect.EffectTerm, kind: str) -> None:
        i, own = term.place, []
        match kind:
            case "reading":
                self.gains[i - 1] = term.values[0]
            case "hidden mass":
                own = [f"x{i}_hidden", f"v{i}_hidden"]
            case "play":
                own = ["x_motor", "v_motor"]
                # With backlash, cart 1 keeps at least a fiftieth of its mass when the motor's mass
                # is separated.
                self._m[0] = max(self._m[0] - term.values[1], 0.02 * self._m[0])
            case "lag":
                own = ["u_lag"]
            case "delay":
                if term.values[0] < 0.0:
                    raise DataError(
                        "the drive leads its log (a negative delay), which no state model can "
                        "represent; simulate the recordings instead"
                    )
                self._delay = _pade(term.values[0])
                own = [f"u_delay_{q + 1}" for q in range(_PADE_ORDER)]
        self._built.setdefault(kind, []).append((term, len(self.states)))
        self.states += own

    def start(self, x0: Sequence[float]) -> Array:
        """Return the state of carts (and hidden masses) released at rest at `x0` (n_carts,).

        Bristles are bent until they hold the carts.
        """
        state = np.zeros(len(self.states))
        state[: 2 * self.n : 2] = x0
        for term, at in self._built.get("hidden mass", []):
            state[at] = x0[term.place - 1]
        for _, at in self._built.get("play", []):
            state[at] = x0[0]
        pull = self._m * self.rate(state, 0.0)[1 : 2 * self.n : 2]
        for i, force, _, at in self._bristles:
            state[at] = np.clip(-pull[i] / force(x=state[2 * i], v=0.0, z=1.0), -1.0, 1.0)
        return state

    def rate(self, state: Array, command: float, *, stop: float = STOP_TIME) -> Array:
        """Return the rate of change of the state under the logged input `command`."""
        n = self.n
        x, v = state[: 2 * n : 2], state[1 : 2 * n : 2]
        out = np.zeros(state.size)
        u = self._arriving(state, command, out)
        d, rates = (np.diff(np.concatenate([[0.0], a, [0.0]])) for a in (x, v))
        force, tension = -self._c * v, self._k * d
        play = self._built.get("play")
        driven = state[play[0][1]] if play else x[0]
        push = u
        for term, law in self._forces:
            if term.effect.place == "spring":
                j = term.place - 1
                tension[j] += law(d=d[j], rate=rates[j], u=u)
            elif term.effect.place == "cart":
                i = term.place - 1
                force[i] += law(x=x[i], v=v[i], u=u)
            elif isinstance(term.effect.law, effect.ForceLaw) and term.effect.law.on_motor:
                push += law(x=driven, v=state[play[0][1] + 1] if play else v[0], u=u)
            else:
                force[0] += law(x=x[0], v=v[0], u=u, on=float(command != 0.0))
        for term, law, past, pulls in self._contacts:
            side, j = 1.0 if past > 0.0 else -1.0, term.place - 1
            if term.effect.place == "spring":
                if side * (d[j] - past) > 0.0:
                    tension[j] += law(d=d[j], rate=rates[j])
            elif side * (x[j] - past) > 0.0:
                f = law(x=x[j], v=v[j])
                force[j] += f if pulls or side * f < 0.0 else 0.0
        for term, at in self._built.get("hidden mass", []):
            i, (mass, stiffness, damping) = term.place - 1, term.values
            f = stiffness * (state[at] - x[i]) + damping * (state[at + 1] - v[i])
            force[i] += f
            out[at], out[at + 1] = state[at + 1], -f / mass
        if play:
            push = self._across(play[0], state, push, out, x[0], v[0])
        force[0] += push
        force += np.diff(tension)
        for i, law, bend, at in self._bristles:
            force[i] += law(x=x[i], v=v[i], z=state[at])
            out[at] = bend(x=x[i], v=v[i], z=state[at])
        slide = np.zeros(n)
        for i, law in self._frictions:
            slide[i] += law(v=v[i], u=u, x=x[i])
        force -= np.clip(self._m * v / stop, -slide, slide)
        out[: 2 * n : 2], out[1 : 2 * n : 2] = v, force / self._m
        return out

    def _arriving(self, state: Array, command: float, out: Array) -> float:
        """Return the force of the drive; fill in the rates of the drive's states."""
        u = command
        for law in self._inputs:
            u = law(u=u)
        if self._delay is not None:
            A, b, c, direct = self._delay
            at = self._built["delay"][0][1]
            past = state[at : at + _PADE_ORDER]
            out[at : at + _PADE_ORDER] = A @ past + b * u
            u = float(c @ past) + direct * u
        for term, at in self._built.get("lag", []):
            out[at] = (u - state[at]) / term.values[0]
            u = float(state[at])
        return u

    def _across(
        self,
        play: tuple[effect.EffectTerm, int],
        state: Array,
        push: float,
        out: Array,
        x: float,
        v: float,
    ) -> float:
        """Return the force that reaches cart 1 across the backlash; fill in the motor's rates."""
        (gap, mass, stiffness, damping), at = play[0].values, play[1]
        apart, rate = state[at] - x, state[at + 1] - v
        side = 1.0 if apart > 0.0 else -1.0
        depth = stiffness * (abs(apart) - 0.5 * gap)
        reach = depth + damping * side * rate
        reach = side * reach if min(depth, reach) > 0.0 else 0.0
        out[at], out[at + 1] = state[at + 1], (push - reach) / mass
        return reach

    def to_control(self) -> "control.NonlinearIOSystem":
        """Return the python-control system: input `u`, outputs `x1`, … as the sensors read them.

        Its parameter `stop`, in s, smooths dry friction: a cart near rest stops in about this time.
        """
        import control

        def update(t: float, state: Array, u: Array, params: Mapping[str, float]) -> Array:
            stop = params.get("stop", STOP_TIME)
            return self.rate(np.asarray(state, dtype=np.float64), float(np.ravel(u)[0]), stop=stop)

        def output(t: float, state: Array, u: Array, params: Mapping[str, float]) -> Array:
            return self.gains * state[: 2 * self.n : 2]

        return control.nlsys(
            update,
            output,
            inputs=["u"],
            outputs=[f"x{i + 1}" for i in range(self.n)],
            states=self.states,
            params={"stop": STOP_TIME},
            name="carts",
        )


def _pade(delay: float) -> tuple[Array, Array, Array, float]:
    """Return A, b, c and d of the Padé approximation of exp(-s delay)."""
    from scipy.signal import tf2ss  # takes half a second, so it is imported here

    q = np.arange(_PADE_ORDER, -1, -1)
    order = _PADE_ORDER
    weight = factorial(2 * order - q) * factorial(order)
    weight /= factorial(2 * order) * factorial(q) * factorial(order - q)
    A, b, c, d = tf2ss(weight * (-delay) ** q, weight * delay**q)
    return A, b[:, 0], c[0], float(d[0, 0])
