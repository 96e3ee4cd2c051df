"""How a long job reports its progress."""

from collections.abc import Callable

Progress = Callable[[str], None]


def silent(text: str) -> None:
    """Do nothing: the default for a job whose progress nobody watches."""
