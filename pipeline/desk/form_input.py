"""Read what people type into a form: a path on this computer, or a number."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import ConfigError


def read_path(typed: str, *, wanted: str, inside: Path | None = None) -> Path:
    """Return a typed path as an absolute path.

    Parameters
    ----------
    wanted : message that asks for a path, if nothing was typed.
    inside : folder to which the path is relative and which it may not leave; None for any path.

    Raises
    ------
    ConfigError : the path is not valid, leaves the folder, begins with `~` of an unknown user, or
        cannot be looked up on this computer.
    """
    if not typed or not typed.isprintable():
        raise ConfigError(wanted)
    try:
        path = (inside / typed if inside else Path(typed).expanduser()).resolve()
        path.exists()
    except RuntimeError:
        raise ConfigError(f"{typed}: this computer has no such user") from None
    except OSError as error:  # the name is too long, or a folder may not be read
        raise ConfigError(f"{_clip(typed, most=60)}: {error.strerror}; {wanted}") from None
    if inside and not path.is_relative_to(inside):
        raise ConfigError(f"{typed}: is outside {inside.name}, where your files are written")
    return path


def read_whole_number(typed: str, *, name: str, least: int, most: int) -> int:
    """Return a typed whole number.

    Raises
    ------
    ConfigError : the text is not a whole number from `least` to `most`.
    """
    number = typed if typed.isascii() and typed.isdecimal() else ""
    # The length is checked first, because converting thousands of digits would take long.
    if number and len(number) <= len(str(most)) and least <= int(number) <= most:
        return int(number)
    found = _clip(typed, most=20)
    raise ConfigError(f"{name}: expected a whole number from {least} to {most}, found {found!r}")


def read_number(
    typed: str, *, name: str, above: float = -math.inf, below: float = math.inf
) -> float:
    """Return a typed number, with a point or a comma; 0 for an empty field.

    Raises
    ------
    ConfigError : the text is not a number between `above` and `below`.
    """
    try:
        value = float(typed.replace(",", ".") or 0)
    except ValueError:
        value = math.nan
    if math.isfinite(value) and above < value < below:
        return value
    bounds = f" above {above:g}" if above > -math.inf else ""
    bounds += f" and below {below:g}" if below < math.inf else ""
    raise ConfigError(f"{name}: expected a number{bounds}, found {_clip(typed, most=20)!r}")


@contextmanager
def keep_refusal(name: str, wrong: dict[str, str]) -> Iterator[None]:
    """Keep the reason for which a field of a form is refused.

    Parameters
    ----------
    wrong : receives the reason, under the name of the field.
    """
    try:
        yield
    except ConfigError as error:
        wrong[name] = str(error).removesuffix(" with --out")


def _clip(typed: str, *, most: int) -> str:
    return f"{typed[:most]}…" if len(typed) > most else typed
