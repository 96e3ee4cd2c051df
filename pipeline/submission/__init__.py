"""Read `submission.toml`: the measurements, the system, and the students' reported numbers."""

from pipeline.submission.edit import new_submission
from pipeline.submission.load import load_submission
from pipeline.submission.models import (
    Author,
    Controller,
    Design,
    Experiment,
    InputOverride,
    InputScale,
    PidController,
    PositionScale,
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    StateFeedbackController,
    Students,
    Submission,
    System,
)

__all__ = [
    "Author",
    "Controller",
    "Design",
    "Experiment",
    "InputOverride",
    "InputScale",
    "PidController",
    "PositionScale",
    "Reported",
    "ReportedFeedback",
    "ReportedStateSpace",
    "StateFeedbackController",
    "Students",
    "Submission",
    "System",
    "load_submission",
    "new_submission",
]
