"""The goal of an exploration: the errors to reach, and the time allowed."""

from dataclasses import dataclass

import numpy as np

from pipeline.errors import ConfigError
from pipeline.names import names_beginning
from pipeline.submission.complaints import nearest


@dataclass(frozen=True, kw_only=True)
class ErrorGoal:
    """The relative error to reach for all parameters with this name prefix; "" means all."""

    prefix: str = ""
    error: float = 0.01

    def missing(self, errors: dict[str, float | None]) -> dict[str, float]:
        """Return the errors that are still too large, by parameter; inf if unknown.

        Raises
        ------
        ConfigError : no parameter's name has the prefix.
        """
        meant = {name: errors[name] for name in names_beginning(errors, self.prefix)}
        if not meant:
            hint = nearest(self.prefix, list(errors))
            raise ConfigError(f'--until "{self.prefix} …": there is no such parameter{hint}')
        return {
            name: np.inf if error is None else error
            for name, error in meant.items()
            if error is None or error > self.error
        }


def read_error_goal(text: str) -> ErrorGoal:
    """Read a goal such as "zeta 1%", "1 %" or "omega_1 0.05 %".

    Raises
    ------
    ConfigError : the text does not have this form.
    """
    before, _, after = text.partition("%")
    *name, share = before.split() or [""]
    try:
        error = float(share) / 100
    except ValueError:
        error = 0.0
    if not 0 < error < 1 or "%" not in text or after.strip() or len(name) > 1:
        raise ConfigError(f'--until "{text}": expected a name and a percentage, as "zeta 1%"')
    return ErrorGoal(prefix=name[0] if name and name[0] != "all" else "", error=error)


def read_time(text: str) -> float:
    """Read a time such as "20min", "90 s" or "1.5h"; return seconds.

    Raises
    ------
    ConfigError : the text does not have this form.
    """
    number = text.strip().rstrip("minsech ")
    unit = text.strip()[len(number) :].strip()
    seconds = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}.get(unit)
    try:
        if seconds is not None and 0 < seconds * float(number) < np.inf:
            return seconds * float(number)
    except ValueError:
        pass
    raise ConfigError(f'--time "{text}": expected a duration, as "20min" or "90s"')
