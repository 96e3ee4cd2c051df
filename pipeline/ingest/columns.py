"""The meaning of columns: time, input, reference, positions of carts; and their units."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import FileTable

_ROLES = (
    ("time", r"t|times?|time ?stamps?|t received|elapsed time"),
    ("input", r"u|inputs?|control effort|effort|duty|duty cycle|voltage|motor|motor voltage|force"),
    ("reference", r"r|ref|reference|set ?point|commanded pos(ition)?|target( v| value)?"),
    ("frequency", r"f|freq|frequency|omega|w"),
)
_POSITION = re.compile(
    r"x ?(\d)|enc(?:oder)? ?(\d)(?: pos(?:ition)?)?|(?:cart|pos|position) ?(\d) ?(?:pos(?:ition)?)?"
)
_ONE_POSITION = re.compile(r"x|y|pos|position|displacement")
# known headings of columns that have no role
_NO_ROLE = re.compile(r"|sample|samples|index|n|no|nr")
_IN_UNITS = ("csv", "workbook", "lvm", "tdms")  # formats whose values are in the submission's units
_COUNTED = re.compile(r"\benc|counts?\b|commanded pos", re.IGNORECASE)
# A unit as in "time [ms]", "x1 (cm)" or "x1_cm". The last form is not for every unit: "u_in" does
# not mean inches.
_UNIT = re.compile(
    r"[\[(]\s*([^\s\[\]()](?:[^\[\]()]*[^\s\[\]()])?)\s*[\])]\s*$|(?<=[a-z0-9])_(s|ms|us|m|cm|mm|V|mV|N|counts?|Hz|dB)$"
)

# For each unit, the factor to a common unit of the same quantity.
_FACTORS = {
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "inch": 0.0254},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "force": {"N": 1.0, "mN": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "torque": {"N m": 1.0, "Nm": 1.0, "N·m": 1.0},
    "angle": {"rad": 1.0, "deg": 0.017453292519943295, "°": 0.017453292519943295}
    | {"turn": 6.283185307179586, "rev": 6.283185307179586},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "rad/s": 0.15915494309189535},
}
_OF_POSITIONS = ("length", "angle")
_OF_INPUTS = ("voltage", "current", "force", "torque")
_PLAIN = ("count", "counts", "pulse", "pulses")  # counts of an encoder or of a controller's output
_SHARES = ("duty", "%")  # shares of the largest input


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column with its meaning: `index` in the table, `unit` as stated in the heading."""

    role: str
    index: int
    name: str
    unit: str | None

    @property
    def cart(self) -> int:
        """The cart whose position this column holds."""
        return int(self.role[1:])

    @property
    def is_counted(self) -> bool:
        """Whether the heading says that this column holds encoder counts."""
        return bool(_COUNTED.search(self.name)) or self.unit in ("count", "counts")

    @property
    def is_duty(self) -> bool:
        """Whether the heading says that this column holds duty counts of the motor's amplifier."""
        return "duty" in self.name.casefold()


def holds_counts(table: FileTable, column: Column) -> bool:
    """Return whether a column holds whole numbers that the format or the heading calls counts."""
    return table.whole[column.index] and (table.form not in _IN_UNITS or column.is_counted)


def conversion(found: str | None, wanted: str) -> float | None:
    """Return the factor from one unit to another; None if they measure different quantities."""
    if found is None or found == wanted:
        return 1.0
    a, b = _plain_micro(found), _plain_micro(wanted)
    return next((of[a] / of[b] for of in _FACTORS.values() if a in of and b in of), None)


def is_count(unit: str) -> bool:
    """Return whether a position unit is the encoder count."""
    return unit.rstrip("s") == "count"


def position_units() -> tuple[str, ...]:
    """Return the known units of positions."""
    return (*_PLAIN, *(unit for quantity in _OF_POSITIONS for unit in _FACTORS[quantity]))


def input_units() -> tuple[str, ...]:
    """Return the known units of inputs."""
    known = (unit for quantity in _OF_INPUTS for unit in _FACTORS[quantity])
    return (*_PLAIN, *_SHARES, *known)


def is_known(unit: str, known: Collection[str]) -> bool:
    """Return whether a unit is known, with either Unicode character for µ."""
    return _plain_micro(unit) in known


def _plain_micro(unit: str) -> str:
    return unit.replace("µ", "u").replace("μ", "u")


def assign_columns(
    table: FileTable, *, explicit: Mapping[str, str | int] | None, free: tuple[int, ...]
) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Return the column of each role, and the headings without a role.

    `explicit` (role to heading or number) has priority over headings. A single position column
    without a number belongs to the only cart in `free`.

    Raises
    ------
    SubmissionError : a stated column does not exist, or two columns have the same role.
    """
    columns: dict[str, Column] = {}
    for role, wanted in (explicit or {}).items():
        index = table.index(wanted)
        columns[role] = _column(table, index, role)
    taken = {column.index for column in columns.values()}
    unused: list[str] = []
    for index, name in enumerate(table.names):
        if index in taken:
            continue
        role = _role(name, free=free)
        if role is None or (explicit and role in explicit):
            if role is not None or not _NO_ROLE.fullmatch(_plain(name)):
                unused.append(name)
        elif role in columns:
            raise SubmissionError(
                f"{table.source}: {columns[role].name!r} and {name!r} both look like {role}; "
                f"say which: columns = {{ {role} = {name!r} }}"
            )
        else:
            columns[role] = _column(table, index, role)
    return columns, tuple(unused)


def _column(table: FileTable, index: int, role: str) -> Column:
    name = table.names[index]
    unit = _UNIT.search(name)
    return Column(role=role, index=index, name=name, unit=(unit[1] or unit[2]) if unit else None)


def _plain(name: str) -> str:
    """Return a heading in lower case, without its unit and special characters."""
    return re.sub(r"[^a-z0-9]+", " ", _UNIT.sub("", name).casefold()).strip()


def _role(name: str, *, free: tuple[int, ...]) -> str | None:
    plain = _plain(name)
    for role, pattern in _ROLES:
        if re.fullmatch(pattern, plain):
            return role
    if match := _POSITION.fullmatch(plain):
        return f"x{next(number for number in match.groups() if number)}"
    if len(free) == 1 and _ONE_POSITION.fullmatch(plain):
        return f"x{free[0]}"
    return None
