"""The plan of a session at the bench: what to record, and within which limits.

It stands in `plan.toml` in the submission folder. `cartlab plan` proposes it, a person may change
it, `cartlab acquire` carries it out.
"""

from math import isclose
from typing import Annotated, Literal, Self

from pydantic import Field

from pipeline.bench.protocol.messages import Tone
from pipeline.submission.models import TomlTable

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PlanLimits(TomlTable):
    """What no run may pass.

    Attributes
    ----------
    input : largest input, input units.
    travel : furthest a cart may be from where it was zeroed, position units.
    """

    input: Positive
    travel: Positive


class PidLoop(TomlTable):
    """The bench's own PID on one cart: duty counts of e in encoder counts."""

    type: Literal["pid"] = "pid"
    kp: Finite
    ki: Finite = 0.0
    kd: Finite = 0.0
    cart: Literal[1, 2] = 1


class StateLoop(TomlTable):
    """State feedback, in the submission's units; () and None: what the design finds."""

    type: Literal["state_feedback"] = "state_feedback"
    gains: tuple[Finite, ...] = ()
    prefilter: Finite | None = None
    cart: int = 1


class Recording(TomlTable):
    """One experiment to record.

    Attributes
    ----------
    id : the experiment's in submission.toml; its files are named after it.
    carts : free to move; the others are held.
    wave : of the input, or in closed loop of the reference.
    amplitude : input units, in closed loop position units; 0: a decay that a hand starts.
    frequency : Hz, of the wave; a chirp starts there.
    frequency_end : Hz, where a chirp ends.
    tones : of a multisine, of each sine the harmonic of `frequency`, its share of the amplitude
        and its phase in rad.
    cycles : periods; the run takes cycles/frequency seconds.
    release : the cart that is pulled out and let go by hand; None: no hand.
    controller : closes the loop.
    settle : s of rest beforehand.
    aim : what it was chosen for by its information, "zeta_2"; "": by habit, or by a person.
    """

    id: str
    kind: Literal["decay", "step", "sine", "sweep", "closed_loop"]
    carts: tuple[int, ...]
    wave: Literal["delta", "square", "sine", "triangle", "sawtooth", "chirp", "multisine"]
    amplitude: Finite
    frequency: Positive
    frequency_end: Positive | None = None
    tones: tuple[tuple[Annotated[int, Field(ge=1)], Finite, Finite], ...] = ()
    cycles: Annotated[int, Field(ge=1)] = 1
    release: int | None = None
    controller: Annotated[PidLoop | StateLoop, Field(discriminator="type")] | None = None
    settle: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    note: str = ""
    aim: str = ""

    @property
    def duration(self) -> float:
        """How long the run takes, s."""
        return self.cycles / self.frequency

    @property
    def sines(self) -> tuple[Tone, ...]:
        """The tones of a multisine, as a bench is told them."""
        return tuple(Tone(harmonic=h, share=share, phase=p) for h, share, p in self.tones)

    def resembles(self, other: Self) -> bool:
        """Whether who wants one of the two no more does not want the other either."""
        words = (self.kind, self.wave, self.carts, self.release, self.controller)
        if words != (other.kind, other.wave, other.carts, other.release, other.controller):
            return False
        mine = (self.amplitude, self.frequency, self.frequency_end or 0.0)
        yours = (other.amplitude, other.frequency, other.frequency_end or 0.0)
        # What is proposed again after other records differs by as much.
        return all(isclose(a, b, rel_tol=0.1) for a, b in zip(mine, yours, strict=True))


class Plan(TomlTable):
    """Everything to record, in order.

    Attributes
    ----------
    baud : of the serial line.
    """

    version: Literal[1] = 1
    baud: Annotated[int, Field(ge=300)] = 115_200
    limits: PlanLimits
    recordings: tuple[Recording, ...] = ()
