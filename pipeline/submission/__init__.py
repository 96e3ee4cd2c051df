"""`submission.toml`: what was measured, on which system, and what the students claim."""

from pipeline.submission.load import load_submission
from pipeline.submission.models import (
    Author,
    Controller,
    Design,
    Experiment,
    Feedback,
    Input,
    InputOverride,
    Pid,
    Position,
    Reported,
    StateFeedback,
    StateSpace,
    Submission,
    System,
)
from pipeline.submission.template import new_submission

__all__ = [
    "Author",
    "Controller",
    "Design",
    "Experiment",
    "Feedback",
    "Input",
    "InputOverride",
    "Pid",
    "Position",
    "Reported",
    "StateFeedback",
    "StateSpace",
    "Submission",
    "System",
    "load_submission",
    "new_submission",
]
