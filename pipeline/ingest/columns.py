"""The meaning of columns: time, input, reference, positions of carts; and their units."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.headings import (
    COUNTS,
    FACTORS,
    SHARES,
    TIME,
    is_known_unit,
    parse_heading,
    plain_name,
    unit_symbol,
)
from pipeline.ingest.formats.table import FileTable

# For each role, the words that name it. Words of the second list count only if none of the first
# is there: a file may have the voltage and also the current, or x and also the angle.
_ROLES = {
    "time": (TIME, ""),
    "input": (
        r"u|inputs?|control effort|effort|duty|duty cycle|voltage|motor|motor voltage|force",
        r"f|current|i|torque|motor current|motor force|control( signal| input)?|command|pwm|"
        r"spannung|motorspannung|kraft|strom|drehmoment|eingang|stellgr(ö|oe)sse|tension|commande|"
        r"potential|excitation|drive|actuator|voltage in|u in|v in|vin",
    ),
    "reference": (
        r"r|ref|reference|set ?point|commanded pos(ition)?|target( v| value)?",
        r"sollwert|soll|f(ü|ue)hrungsgr(ö|oe)sse|consigne|desired( position)?|"
        r"command(ed)? position",
    ),
    "frequency": (r"f|freq|frequency|omega|w|ω|frequenz|kreisfrequenz|fréquence", ""),
}
_POSITION = re.compile(
    r"x ?(\d)|(?:enc|encoder) ?(\d)(?: (?:pos|position|count|counts))?|"
    r"(?:(?:cart|mass|pos|position|displacement|weg|y|theta|angle|winkel|wagen) ?(\d)|"
    r"(?:position|pos|displacement|weg|angle|winkel) (?:of )?(?:cart|mass|wagen) ?(\d))"
    r"(?: ?(?:pos|position|displacement))?"
)
_ONE_POSITION = (
    r"x|y|pos|position|displacement",
    r"weg|auslenkung|distance|distanz|abstand|angle|theta|θ|phi|φ|winkel|encoder|enc|"
    r"encoder pos(ition)?|déplacement|deplacement|elongation|laser|sensor|cart|cart position",
)
# known headings of columns that have no role
_NO_ROLE = re.compile(r"|sample|samples|index|n|no|nr|i|row|#")
_IN_UNITS = ("csv", "workbook", "lvm", "tdms")  # formats whose values are in the submission's units
_COUNTED = re.compile(r"\benc|counts?\b|commanded pos", re.IGNORECASE)
# Names of a time that are its unit, too.
_NAMED_UNITS = {
    "millis": "ms", "micros": "us", "milliseconds": "ms", "microseconds": "us",
}  # fmt: skip
_OF_POSITIONS = ("length", "angle")
_OF_INPUTS = ("voltage", "current", "force", "torque")


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
        return bool(_COUNTED.search(self.name)) or self.unit == "count"

    @property
    def is_duty(self) -> bool:
        """Whether the heading says that this column holds duty counts of the motor's amplifier."""
        return "duty" in self.name.casefold()


def holds_counts(table: FileTable, column: Column) -> bool:
    """Return whether a column holds whole numbers that the format or the heading calls counts."""
    return table.whole[column.index] and (table.form not in _IN_UNITS or column.is_counted)


def is_count(unit: str) -> bool:
    """Return whether a position unit is the encoder count."""
    return unit.rstrip("s") == "count"


def position_units() -> tuple[str, ...]:
    """Return the known units of positions."""
    return (*COUNTS, *(unit for quantity in _OF_POSITIONS for unit in FACTORS[quantity]))


def input_units() -> tuple[str, ...]:
    """Return the known units of inputs."""
    known = (unit for quantity in _OF_INPUTS for unit in FACTORS[quantity])
    return (*COUNTS, *SHARES, *known)


def is_known(unit: str, known: Collection[str]) -> bool:
    """Return whether a unit is known; "CM" is not, because its prefix may be meant otherwise."""
    symbol = unit_symbol(unit)
    spelled = symbol is not None and unit.casefold() != symbol.casefold()
    return unit in known or (spelled and symbol in known)


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
        columns[role] = _column(table, table.index(wanted), role)
    taken = {column.index for column in columns.values()}
    plain = [plain_name(name) for name in table.names]
    is_time = [bool(re.fullmatch(TIME, name)) for name in plain]
    has_time = "time" in columns or any(is_time)
    found: dict[str, list[tuple[int, int]]] = {}  # for each role, (rank, column)
    unused: list[str] = []
    for index, name in enumerate(plain):
        if index in taken:
            continue
        role, rank = _role(name, free=free, has_time=has_time, unit=_unit(table, index))
        if role is None or (explicit and role in explicit):
            if role is not None or not _NO_ROLE.fullmatch(name):
                unused.append(table.names[index])
        else:
            found.setdefault(role, []).append((rank, index))
    seconds = [i for i in range(len(plain)) if _unit(table, i) in FACTORS["time"]]
    if not has_time and len(seconds) == 1 and table.names[seconds[0]] in unused:
        found["time"] = [(0, seconds[0])]  # its unit says that it is the time
        unused.remove(table.names[seconds[0]])
    for role, candidates in found.items():
        (rank, first), *others = sorted(candidates)
        if others and others[0][0] == rank:
            a, b = (table.names[index] for index in (first, others[0][1]))
            raise SubmissionError(
                f"{table.source}: {a!r} and {b!r} both look like {role}; "
                f"say which: columns = {{ {role} = {a!r} }}"
            )
        columns[role] = _column(table, first, role)
        unused += [table.names[index] for _, index in others]
    return columns, tuple(unused)


def refuse_unknown_unit(table: FileTable, column: Column, *, stated: str = "") -> None:
    """Refuse a column whose heading states a unit that is not known.

    Raises
    ------
    SubmissionError : the unit is not known, and it is not the one that the submission states.
    """
    unit = column.unit
    if unit is not None and unit != stated and not is_known_unit(unit):
        raise SubmissionError(
            f"{table.source}: {column.name!r} states the unit {unit!r}, which is not known: which "
            "unit is it? Write it in the heading, as in 'x1 [mm]'"
        )


def _unit(table: FileTable, index: int) -> str | None:
    return parse_heading(table.names[index]).unit


def _column(table: FileTable, index: int, role: str) -> Column:
    unit = _unit(table, index)
    if unit is None and role == "time":  # "millis" is a name and a unit
        unit = _NAMED_UNITS.get(plain_name(table.names[index]))
    return Column(role=role, index=index, name=table.names[index], unit=unit)


def _role(
    plain: str, *, free: tuple[int, ...], has_time: bool, unit: str | None
) -> tuple[str | None, int]:
    """Return the role that a heading names, and the rank of the word; None without a role.

    A file with a time is no table of frequencies: there, F is a force and omega a speed.
    """
    for role, words in _ROLES.items():
        for rank, pattern in enumerate(words):
            if not re.fullmatch(pattern or "$^", plain):
                continue
            if role == "frequency" and has_time:
                continue
            if plain == "f" and role == "input" and not has_time:
                continue
            if plain == "i" and unit is None:  # a row's number
                continue
            return role, rank
    if match := _POSITION.fullmatch(plain):
        return f"x{next(number for number in match.groups() if number)}", 0
    for rank, pattern in enumerate(_ONE_POSITION):
        if len(free) == 1 and re.fullmatch(pattern, plain):
            return f"x{free[0]}", rank
    return None, 0
