"""How a long job says what it is doing."""

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(text: str) -> None:
    """Say nothing: the default of a job that nobody watches."""
