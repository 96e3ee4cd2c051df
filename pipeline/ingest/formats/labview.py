"""The common parts of LabVIEW's two formats: units in words, and time as an interval."""

import numpy as np

from pipeline.arrays import Array

# Units as LabVIEW spells them; others stay as they are.
_UNITS = {
    "volts": "V", "volt": "V", "amps": "A", "amperes": "A", "newtons": "N", "seconds": "s",
    "meters": "m", "metres": "m", "centimeters": "cm", "millimeters": "mm", "inches": "in",
    "degrees": "deg", "radians": "rad", "revolutions": "rev", "hertz": "Hz",
}  # fmt: skip
_LONGEST_UNIT = 12  # characters


def with_unit(name: str, unit: str) -> str:
    """Return a heading with its unit, "x1 [cm]"; unchanged if it already has one."""
    unit = unit.strip()
    if not unit or len(unit) > _LONGEST_UNIT or name.rstrip().endswith(("]", ")")):
        return name
    return f"{name} [{_UNITS.get(unit.casefold(), unit)}]"


def even_times(n: int, *, start: float, interval: float) -> Array:
    """Return n times in s, from the first time and the interval."""
    return start + interval * np.arange(n, dtype=np.float64)
