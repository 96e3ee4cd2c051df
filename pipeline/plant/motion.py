"""The chain with its effects as an ordinary differential equation, for python-control.

It is built from the same description as the exported programs. The simulator switches at exact
instants, but the right-hand side given here suits any solver. Two things are approximate:

- Dry friction is set-valued at rest. Here it brakes a slow cart like a damper that would stop it in
  `stop` s, up to the friction's size. So a cart held by friction creeps at force / mass * stop.
- A delay is a Padé approximation of the fourth order, good up to a frequency of about 4 / delay
  (rad/s). See C. Moler, C. Van Loan, SIAM Review 45 (2003), 3-49, section 3, for the exponential.

Without effects, the equation is that of the linear chain.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import cos, exp, pi, sin
from types import CodeType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import factorial

from pipeline.arrays import Array
from pipeline.plant import effect
from pipeline.plant.export import Description, Force
from pipeline.setup import Units

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


@lru_cache(maxsize=256)  # a model has some dozen expressions
def _compiled(text: str) -> CodeType:
    return compile(text, "<law>", "eval")


class _Moment:
    """The values of the names in a model's expressions, at one moment."""

    def __init__(self, **values: Any) -> None:
        self.values = values

    def value(self, text: str, **more: float) -> float:
        """Return the value of an expression, in which further names may stand."""
        return float(eval(_compiled(text), _FUNCTIONS, self.values | more))

    def force(self, part: Force, **more: float) -> float:
        """Return a force; that of an open contact is zero."""
        force = self.value(part.force, **more)
        if not part.side:
            return force
        side = 1.0 if self.value(part.side) > 0.0 else -1.0
        acts = side * self.value(part.depth, **more) > 0.0
        return force if acts and (part.pulls or side * force < 0.0) else 0.0


class EquationsOfMotion:
    """The state and its rate of change.

    Attributes
    ----------
    states : names of the states. First come x1, v1, x2, v2, …, then the states of the effects:
        `x_motor` and `v_motor` with backlash, `x1_hidden` and `v1_hidden` of a hidden mass,
        `u_lag`, `u_delay_1`, …, and `z1` of a bristle.
    """

    def __init__(self, model: effect.AugmentedChain) -> None:
        """Read the laws of a model.

        Raises
        ------
        DataError : the motor acts before its logged input; no state model can do that.
        """
        self._model = d = Description(model, units=Units(position="", input=""))
        self._p = SimpleNamespace(**{number.name: number.value for number in d.numbers})
        self._names = [body.name for body in d.bodies]
        self.states = [f"{letter}{body.suffix}" for body in d.bodies for letter in "xv"]
        fixed = _Moment(p=self._p)
        self._m = np.array([fixed.value(body.mass) for body in d.bodies])
        self._lag = fixed.value(d.lag) if d.lag else 0.0
        self._delay = _pade(fixed.value(d.delay)) if d.delay else None
        if d.lag:
            self.states.append("u_lag")
        if d.delay:
            self.states += [f"u_delay_{q + 1}" for q in range(_PADE_ORDER)]
        self.states += [bristle.name for bristle in d.bristles]

    def _moment(self, state: Array, **more: float) -> _Moment:
        moving = np.reshape(state[: 2 * len(self._names)], (-1, 2)).T.tolist()
        x, v = (SimpleNamespace(**dict(zip(self._names, part, strict=True))) for part in moving)
        return _Moment(p=self._p, x=x, v=v, **more)

    def start(self, x0: Sequence[float]) -> Array:
        """Return the state of carts (and hidden masses) released at rest at `x0` (n_carts,).

        Bristles are bent until they hold the carts.
        """
        state = np.zeros(len(self.states))
        state[: 2 * len(self._names) : 2] = [x0[body.start] for body in self._model.bodies]
        now = self._moment(state)
        pull = self._m * self.rate(state, 0.0)[1 : 2 * len(self._names) : 2]
        for bristle in self._model.bristles:
            held = pull[self._names.index(bristle.body)] / now.value(bristle.force, z=1.0)
            state[self.states.index(bristle.name)] = np.clip(-held, -1.0, 1.0)
        return state

    def readings(self, state: Array) -> list[float]:
        """Return the readings of the carts' sensors."""
        now = self._moment(state)
        return [now.value(reading) for reading in self._model.readings]

    def rate(self, state: Array, command: float, *, stop: float = STOP_TIME) -> Array:
        """Return the rate of change of the state under the logged input `command`."""
        d, out = self._model, np.zeros(state.size)
        u = self._arriving(state, command, out)
        now = self._moment(state, u=u, on=float(command != 0.0))
        force, slide = dict.fromkeys(self._names, 0.0), dict.fromkeys(self._names, 0.0)
        force[d.driven] += u
        for part in d.forces:
            force[part.body] += now.force(part)
        for spring in d.springs:
            stretch = {"d": now.value(spring.stretch), "rate": now.value(spring.rate)}
            tension = sum(now.force(part, **stretch) for part in spring.tension)
            for body, pull in ((spring.left, tension), (spring.right, -tension)):
                if body:
                    force[body] += pull
        for hidden, part in d.links:
            pull = now.force(part)
            force[part.body] += pull
            force[hidden] -= pull
        if d.play:
            push = self._across(now)
            force["cart_1"] += push
            force["motor"] -= push
        for bristle in d.bristles:
            at = self.states.index(bristle.name)
            force[bristle.body] += now.value(bristle.force, z=float(state[at]))
            out[at] = now.value(bristle.rate, z=float(state[at]))
        for part in d.frictions:
            slide[part.body] += now.value(part.force)
        v, most = state[1 : 2 * len(self._names) : 2], np.array([*slide.values()])
        total = np.array([*force.values()]) - np.clip(self._m * v / stop, -most, most)
        out[: 2 * v.size : 2], out[1 : 2 * v.size : 2] = v, total / self._m
        return out

    def _arriving(self, state: Array, command: float, out: Array) -> float:
        """Return the force of the drive; fill in the rates of the drive's states."""
        u, fixed = command, _Moment(p=self._p)
        for _, law in self._model.inputs:
            u = fixed.value(law, u=u)
        if self._delay is not None:
            A, b, c, direct = self._delay
            at = self.states.index("u_delay_1")
            past = state[at : at + _PADE_ORDER]
            out[at : at + _PADE_ORDER] = A @ past + b * u
            u = float(c @ past) + direct * u
        if self._lag:
            at = self.states.index("u_lag")
            out[at] = (u - state[at]) / self._lag
            u = float(state[at])
        return u

    def _across(self, now: _Moment) -> float:
        """Return the force that reaches cart 1 across the backlash."""
        assert self._model.play
        gap, stiffness, damping = map(now.value, self._model.play)
        apart, rate = now.value("x.motor - x.cart_1"), now.value("v.motor - v.cart_1")
        side = 1.0 if apart > 0.0 else -1.0
        depth = stiffness * (abs(apart) - 0.5 * gap)
        reach = depth + damping * side * rate
        return side * reach if min(depth, reach) > 0.0 else 0.0

    def to_control(self) -> "control.NonlinearIOSystem":
        """Return the python-control system: input `u`, outputs `x1`, … as the sensors read them.

        Its parameter `stop`, in s, smooths dry friction: a cart near rest stops in about this time.
        """
        import control

        def update(t: float, state: Array, u: Array, params: Mapping[str, float]) -> Array:
            stop = params.get("stop", STOP_TIME)
            return self.rate(np.asarray(state, dtype=np.float64), float(np.ravel(u)[0]), stop=stop)

        def output(t: float, state: Array, u: Array, params: Mapping[str, float]) -> Array:
            return np.array(self.readings(state))

        return control.nlsys(
            update,
            output,
            inputs=["u"],
            outputs=[f"x{i + 1}" for i in range(self._model.n)],
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
