"""The `cartlab` command: parse, call one function, write, exit code."""

# isort: off
# In this order `cartlab --help` lists the commands: as a lab needs them.
from pipeline.cli.common import app, main
from pipeline.cli import reports, models, plan, acquire, explore, emulate, grading, desk, demo

__all__ = [
    "acquire", "app", "demo", "desk", "emulate", "explore", "grading", "main", "models", "plan",
    "reports",
]  # fmt: skip
