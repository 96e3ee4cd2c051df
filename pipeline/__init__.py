"""cartlab: identification, control and grading for the mass-spring-damper laboratory.

In a notebook: `from pipeline import analyse, check, explain`, then `analyse("team-07")`.
"""

TYPE_CHECKING = False  # replaces typing.TYPE_CHECKING, as importing typing is slow
if TYPE_CHECKING:
    from typing import Any

__version__ = "0.2.0"


def __getattr__(name: str) -> "Any":
    """Import a notebook function on first use, so that the command line starts quickly."""
    if name in ("analyse", "check", "explain"):
        from importlib import import_module

        return getattr(import_module("pipeline.notebook"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
