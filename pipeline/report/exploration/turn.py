"""A turn of an exploration: what was known once its records were there, and what came next."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """One explanation of the gap: its effects in words, and its weight among those in dispute."""

    name: str
    weight: float


@dataclass(frozen=True, kw_only=True)
class Turn:
    """What was known at one turn.

    Attributes
    ----------
    seconds : at the bench so far, rests included.
    recorded : ids of the recordings made in this turn.
    errors : relative standard error of each named parameter, by name; None where it has none.
    verdict : of the gap; "" where it could not be looked for.
    explanations : in dispute, that of the model first, or the one that is named; none where the
        linear chain does.
    left, floor : what the model leaves of the motion, and what noise alone would.
    reached : all that was asked for is known, and what else acts has a name or is not there.
    said : what is known, what is doubted and why the next recording is made, in one sentence.
    """

    seconds: float
    recorded: tuple[str, ...]
    errors: dict[str, float | None]
    verdict: str
    explanations: tuple[Explanation, ...]
    left: float | None
    floor: float | None
    reached: bool
    said: str
