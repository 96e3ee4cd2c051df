"""cartlab: identification, control and grading for the mass-spring-damper laboratory.

In a notebook: `from pipeline import analyse`, then `analyse("team-07")`.
"""

TYPE_CHECKING = False  # as that of typing, which takes its time to load
if TYPE_CHECKING:
    from pipeline.notebook import analyse as analyse

__version__ = "0.2.0"


def __getattr__(name: str) -> object:
    """Load `analyse` when it is asked for, as the command line must answer at once."""
    if name == "analyse":
        from pipeline.notebook import analyse

        return analyse
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
