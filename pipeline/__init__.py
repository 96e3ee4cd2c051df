"""cartlab: identification, control and grading for the mass-spring-damper laboratory.

In a notebook: `from pipeline import analyse`, then `analyse("team-07")`.
"""

TYPE_CHECKING = False  # as that of typing, which takes its time to load
if TYPE_CHECKING:
    from typing import Any

__version__ = "0.2.0"


def __getattr__(name: str) -> "Any":
    """Load `analyse` when it is asked for, as the command line must answer at once."""
    if name == "analyse":
        from importlib import import_module

        return import_module("pipeline.notebook").analyse
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
