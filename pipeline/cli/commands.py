"""Load all commands, in the order of `cartlab --help`."""

# isort: off
# `cartlab --help` lists the commands in this order: as a lab needs them.
from pipeline.cli.common import app, run
from pipeline.cli import (
    reports,
    models,
    plan,
    acquire,
    explore,
    emulate,
    grading,
    desk,
    demo,
    doctor,
)

__all__ = [
    "acquire", "app", "demo", "desk", "doctor", "emulate", "explore", "grading", "models", "plan",
    "reports", "run",
]  # fmt: skip
