"""The plan of a session at the bench: what to record, and within which limits.

It is `plan.toml` in the submission folder. `cartlab plan` proposes it, a person may change it, and
`cartlab acquire` makes the recordings.
"""

from math import isclose
from typing import Annotated, Literal, Self

from pydantic import Field

from pipeline.bench.protocol.messages import Tone
from pipeline.submission.models import TomlTable

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PlanLimits(TomlTable):
    """The limits of every run.

    Attributes
    ----------
    input : largest input, in input units.
    travel : largest distance of a cart from its zero, in position units.
    """

    input: Positive
    travel: Positive


class PidLoop(TomlTable):
    """Gains of the bench's own PID on one cart, from encoder counts to duty counts."""

    type: Literal["pid"] = "pid"
    kp: Finite
    ki: Finite = 0.0
    kd: Finite = 0.0
    cart: Literal[1, 2] = 1


class StateLoop(TomlTable):
    """State feedback in the submission's units; () and None stand for the gains of the design."""

    type: Literal["state_feedback"] = "state_feedback"
    gains: tuple[Finite, ...] = ()
    prefilter: Finite | None = None
    cart: int = 1


class Recording(TomlTable):
    """One experiment to record.

    Attributes
    ----------
    id : the id of the experiment in submission.toml. The data file has the same name.
    carts : the carts that are free to move; all others are held.
    wave : waveform of the input or, in closed loop, of the reference.
    amplitude : amplitude in input units or, in closed loop, in position units. Zero for a decay
        started by hand.
    frequency : frequency of the wave in Hz, at which a chirp starts.
    frequency_end : frequency in Hz at which a chirp ends.
    tones : the sines of a multisine. Each has the harmonic of `frequency`, its share of the
        amplitude and its phase in rad.
    cycles : number of periods. The run takes cycles/frequency seconds.
    release : the cart that is pulled out and released by hand; None if no cart is released.
    controller : the controller that closes the loop.
    settle : time of rest before the run, in s.
    aim : the goal for which cartlab chose the recording, such as "zeta_2" or "gap". It is empty for
        a standard recording, and for one that a person chose.
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
        """Duration of the run in s."""
        return self.cycles / self.frequency

    @property
    def sines(self) -> tuple[Tone, ...]:
        """The tones of a multisine in the bench's form."""
        return tuple(Tone(harmonic=h, share=share, phase=p) for h, share, p in self.tones)

    def resembles(self, other: Self) -> bool:
        """Return whether a person who refuses one of two recordings would refuse the other too."""
        words = (self.kind, self.wave, self.carts, self.release, self.controller)
        if words != (other.kind, other.wave, other.carts, other.release, other.controller):
            return False
        mine = (self.amplitude, self.frequency, self.frequency_end or 0.0)
        yours = (other.amplitude, other.frequency, other.frequency_end or 0.0)
        # The same proposal, made again after other recordings, may differ by 10 %.
        return all(isclose(a, b, rel_tol=0.1) for a, b in zip(mine, yours, strict=True))


class Plan(TomlTable):
    """Everything to record, in order.

    Attributes
    ----------
    baud : speed of the serial line.
    """

    version: Literal[1] = 1
    baud: Annotated[int, Field(ge=300)] = 115_200
    limits: PlanLimits
    recordings: tuple[Recording, ...] = ()
