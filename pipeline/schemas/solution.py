"""`solution.json`, schema `cartlab-solution/1`."""

from typing import Annotated, Literal

from pydantic import Field

from pipeline.schemas.base import Document, Margins, Number, Numbers, Provenance, Units


class SolutionSubmission(Document):
    """Which submission it was made from."""

    title: str
    carts: int
    springs: tuple[bool, ...]
    units: Units


class ExpectedParameter(Document):
    """A parameter and what the rubric gives full points for; null where it is not judged."""

    name: str
    unit: str
    value: float
    std: Number
    percent: Annotated[Number, Field(description="beyond the reference's own bounds")]
    low: Annotated[Number, Field(description="the least for full points, in its unit")]
    high: Annotated[Number, Field(description="the most for full points, in its unit")]
    tolerance: Annotated[Number, Field(description="half of the way between the two")]


class ExpectedStateSpace(Document):
    """The state model, and how far each entry moves within the parameters' tolerances."""

    A: tuple[Numbers, ...]
    A_tolerance: tuple[Numbers, ...]
    B: tuple[Numbers, ...]
    B_tolerance: tuple[Numbers, ...]


class ReferenceFeedback(Document):
    """The reference design; gains are not unique, so others may be as right."""

    cart: int
    method: Literal["poles", "lqr"]
    sample_time: float
    gains: Numbers
    prefilter: Number
    poles: Annotated[tuple[tuple[Number, Number], ...], Field(description="[re, im], rad/s")]
    overshoot_percent: Number
    settling_time: Number
    peak_input: Number
    margins: Margins | None = None


class Doubt(Document):
    """A consistency check that failed: the numbers are no reference before it is explained."""

    id: str
    message: str


class Solution(Document):
    """What a rubric would expect, with tolerances."""

    schema_: Annotated[Literal["cartlab-solution/1"], Field(alias="schema")]
    submission: SolutionSubmission
    rubric: Annotated[str, Field(description="title of the one that says what is accepted")]
    parameters: tuple[ExpectedParameter, ...]
    state_space: ExpectedStateSpace | None
    feedback: ReferenceFeedback | None
    doubts: tuple[Doubt, ...] = ()
    provenance: Provenance
