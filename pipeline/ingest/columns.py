"""What a heading says: the name of a column, its unit, its run, and its role in a recording."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from pipeline.errors import SubmissionError
from pipeline.ingest.table import FileTable

# For each quantity, its units and their factors to a common one.
FACTORS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "length": {
        "m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048,
    },
    "voltage": {"V": 1.0, "mV": 1e-3, "kV": 1e3, "uV": 1e-6},
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "current": {"A": 1.0, "mA": 1e-3},
    "torque": {"Nm": 1.0, "mNm": 1e-3},
    "angle": {
        "rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295, "rev": 6.283185307179586,
    },
    "frequency": {"Hz": 1.0, "kHz": 1e3, "rad/s": 0.15915494309189535},
}  # fmt: skip
COUNTS, SHARES = ("count", "pulse"), ("duty", "%")
_OTHER = (*COUNTS, *SHARES, "dB", "m/s", "cm/s", "mm/s", "m/s2", "cm/s2", "mm/s2", "deg/s",
          "rad/s2", "1", "C", "K", "Pa", "bar", "W", "Ohm", "kg", "g", "T", "uT")  # fmt: skip
# Other spellings, in lower case.
_WORDS = {
    "s": "sec secs second seconds sekunde sekunden seconde secondes segundo segundos secondi",
    "ms": "msec msecs millisec millisecs millisecond milliseconds millis millisekunde "
    "millisekunden millisecondes milisegundos",
    "us": "usec usecs microsec microsecond microseconds micros mikrosekunde mikrosekunden",
    "ns": "nsec nanosecond nanoseconds",
    "min": "minute minutes mins minuten",
    "h": "hr hrs hour hours stunde stunden",
    "m": "meter meters metre metres metri metros mètres",
    "dm": "decimeter decimeters",
    "cm": "centimeter centimeters centimetre centimetres zentimeter",
    "mm": "millimeter millimeters millimetre millimetres",
    "um": "micron microns micrometer micrometers micrometre mikrometer",
    "in": "inch inches zoll",
    "ft": "foot feet",
    "V": "volt volts volt(s) vdc",
    "mV": "millivolt millivolts",
    "A": "amp amps ampere amperes",
    "mA": "milliamp milliamps milliampere milliamperes",
    "N": "newton newtons",
    "Nm": "n·m n*m n.m newton-meter newton-meters newton-metre newtonmeter",
    "rad": "radian radians bogenmass",
    "deg": "° degree degrees grad º",
    "rev": "revolution revolutions turn turns umdrehung umdrehungen",
    "Hz": "hertz cps 1/s",
    "rad/s": "rad/sec rads/s radians/s radian/s rad·s-1 rad*s^-1",
    "count": "counts cnt cnts ticks tick inkremente increments",
    "pulse": "pulses pulsee impulse",
    "%": "percent prozent pct",
    "m/s2": "m/s^2 m/s² m/s/s",
    "cm/s2": "cm/s^2 cm/s²",
    "mm/s2": "mm/s^2 mm/s²",
    "rad/s2": "rad/s^2 rad/s²",
    "1": "- a.u. au none arb unitless",
    "C": "°c degc",
    "g": "gram",
}
_SYMBOLS = {*(unit for units in FACTORS.values() for unit in units), *_OTHER}
_SPELLED = {
    **{unit.casefold(): unit for unit in sorted(_SYMBOLS)},
    **{word: unit for unit, words in _WORDS.items() for word in words.split(" ")},
    "n m": "Nm", "t": "", "k": "", "c": "",
}  # fmt: skip
# Units after an underscore, as in "x1_cm". It is not for every unit: "u_in" is not in inches.
_UNDERSCORED = ("s", "ms", "us", "ns", "sec", "min", "m", "cm", "mm", "um", "V", "mV", "N", "A",
                "mA", "rad", "deg", "count", "counts", "Hz", "dB", "volts", "seconds")  # fmt: skip
_RUN = re.compile(
    r"^(?:run|trial|messung|versuch|lauf|essai|latest|data ?set)\s*#?\s*(\d{0,4})\s*[:,|]\s*(?=\S)|"
    r"[\s,;|(\[]*\b(?:run|trial|messung|versuch|lauf|essai)\s*#?\s*(\d{1,4})\s*[)\]]?$",
    re.IGNORECASE,
)
_BRACKETS = re.compile(r"\[([^\[\]]*)\]|\(([^()]*)\)")
_WORD = re.compile(r"[^\W\d_°%][^\W\d_]{0,19}[²2]?")  # may be a unit behind a clear mark
_NUMBER = re.compile(r"[-+]?[\d.]+[eE][-+]?\d+")
_LABEL = re.compile(
    r"raw|filtered|measured|simulated|smoothed|left|right|top|bottom|abs|rel|relative|absolute|"
    r"output|input|ref|reference|motor|encoder|sensor|position|laser|.*[\s_#]?\d+",
    re.IGNORECASE,
)
TIME = (
    r"t|times?|time ?stamps?|t received|elapsed( time)?|zeit|uhrzeit|temps|tiempo|tempo|"
    r"date ?time|time of day|rel time|time ?axis|seconds?|sec|millis|micros|"
    r"milliseconds|microseconds"
)
_LONGEST = 20  # characters of a unit


@dataclass(frozen=True, kw_only=True)
class Heading:
    """The parts of a heading.

    Attributes
    ----------
    name : the rest of the heading.
    unit : its symbol, such as "ms" for "milliseconds"; as written if it is not known; None if the
        heading states none.
    run : number of the run, or "".
    """

    name: str
    unit: str | None
    run: str


def unit_symbol(text: str) -> str | None:
    """Return the symbol of a unit that is written as a symbol or as a word; None if unknown."""
    plain = text.strip().strip("\"'").replace("µ", "u").replace("μ", "u")
    plain = plain.removeprefix("in ") if plain.startswith("in ") else plain
    if plain in _SYMBOLS:
        return plain
    return _SPELLED.get(" ".join(plain.casefold().split())) or None


def is_known_unit(unit: str) -> bool:
    """Return whether a unit, or a ratio of two units, is known."""
    if unit_symbol(unit) is not None:
        return True
    parts = re.split(r"[/ ]+(?:per )?", unit)
    return len(parts) == 2 and all(unit_symbol(part) is not None for part in parts)


def conversion(found: str | None, wanted: str) -> float | None:
    """Return the factor from one unit to another; None if they measure different quantities."""
    if found is None or found == wanted:
        return 1.0
    a, b = unit_symbol(found) or found, unit_symbol(wanted) or wanted
    if a == b:
        return 1.0
    return next((of[a] / of[b] for of in FACTORS.values() if a in of and b in of), None)


@lru_cache(maxsize=1024)
def parse_heading(text: str) -> Heading:
    """Return the name, the unit and the run of a heading, however they are written.

    Units may stand as in "x1 [mm]", "x1 (mm)", "x1/mm", "x1, mm", "x1 in mm" and "x1_mm"; a number
    of a run before or after them.
    """
    rest, run = " ".join(text.split()), ""
    if match := _RUN.search(rest):
        run = match[1] or match[2] or ""
        rest = (rest[: match.start()] + rest[match.end() :]).strip(" ,;:|")
    # The last bracket that holds a unit; a label, as in "x1 (left)", is a part of the name.
    for bracket in reversed(list(_BRACKETS.finditer(rest[:200]))):
        square, held = bracket[1] is not None, (bracket[1] or bracket[2] or "").strip()
        unit = unit_symbol(held)
        is_label = not held or (not square and _LABEL.fullmatch(held)) or held.count(" ") > 1
        if len(held) > _LONGEST or (unit is None and is_label):
            continue
        name = f"{rest[: bracket.start()]} {rest[bracket.end() :]}"
        return Heading(name=_tidy(name), unit=unit or held, run=run)
    name, *ratio = rest.rsplit("/", 2)  # as in "v / (m/s)"
    unit = "/".join(part.strip(" ()") for part in ratio)
    if name.strip() and len(ratio) == 2 and is_known_unit(unit):
        return Heading(name=_tidy(name), unit=unit_symbol(unit) or unit, run=run)
    for mark, any_word in ((" / ", True), ("/", True), (" in ", True), (",", False), (" ", False)):
        name, found, last = rest.rpartition(mark)
        unit = unit_symbol(last)
        if mark == " " and (unit is None or len(last) < 2 or last in ("in", "min", "none", "au")):
            continue
        word = any_word and _WORD.fullmatch(last.strip())
        if found and name.strip() and (unit or word):
            return Heading(name=_tidy(name), unit=unit or last.strip(), run=run)
    name, found, last = rest.rpartition("_")
    if found and name and last in _UNDERSCORED:
        return Heading(name=_tidy(name), unit=unit_symbol(last), run=run)
    return Heading(name=_tidy(rest), unit=None, run=run)


def is_time(text: str) -> bool:
    """Return whether a heading names the time."""
    return re.fullmatch(TIME, plain_name(text)) is not None


def plain_name(text: str) -> str:
    """Return a heading in lower case, without its unit, run and special characters."""
    words = parse_heading(text).name.casefold().replace("ß", "ss")
    return re.sub(r"[\W_]+", " ", words).strip()


def are_units(fields: Sequence[str]) -> bool:
    """Return whether the fields of a row below the names are their units."""
    held = [field.strip(' "') for field in fields if any(c.isalpha() or c in "%°" for c in field)]
    held = [field for field in held if not _NUMBER.fullmatch(field)]
    known = [unit_symbol(field.strip("()[]")) is not None for field in held]
    bracketed = [field[0] in "([" and field[-1] in ")]" for field in held]
    return bool(held) and (all(bracketed) or 2 * sum(known) > len(held))


def join_unit(name: str, unit: str) -> str:
    """Return a heading with its unit, "x1 [cm]"; unchanged if it already has one."""
    unit = unit.strip(' ()[]"')
    if not unit or len(unit) > _LONGEST or parse_heading(name).unit is not None:
        return name
    return f"{name.strip()} [{unit_symbol(unit) or unit}]"


def _tidy(name: str) -> str:
    return " ".join(name.replace('"', " ").split()).strip(" ,;:|/")


# -------------------------------------------------------------------------------------------- roles

# For each role, the words that name it. Words of the second list count only if none of the first
# is there: a file may have the voltage and also the current, or x and also the angle.
_ROLES = {
    "frequency": (r"f|freq|frequency|omega|w|ω|frequenz|kreisfrequenz|fréquence",),
    "time": (TIME,),
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
_COUNTED = re.compile(r"\benc|counts?\b|commanded pos", re.IGNORECASE)
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
    return table.whole[column.index] and (table.format.positions != "heading" or column.is_counted)


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
    stated = {role: table.index(wanted) for role, wanted in (explicit or {}).items()}
    columns = {role: _column(table, index, role) for role, index in stated.items()}
    plain = [plain_name(name) for name in table.names]
    has_time = "time" in columns or any(re.fullmatch(TIME, name) for name in plain)
    found: dict[str, list[tuple[int, int]]] = {}  # for each role, (rank, column)
    unused: list[int] = []
    for index, name in enumerate(plain):
        if index in stated.values():
            continue
        role, rank = _role(name, free=free, has_time=has_time, unit=_unit(table, index))
        if role and role not in stated:
            found.setdefault(role, []).append((rank, index))
        elif role or not _NO_ROLE.fullmatch(name):
            unused.append(index)
    seconds = [i for i in range(len(plain)) if _unit(table, i) in FACTORS["time"]]
    if not has_time and len(seconds) == 1 and seconds[0] in unused:
        found["time"] = [(0, seconds[0])]  # its unit says that it is the time
        unused.remove(seconds[0])
    for role, candidates in found.items():
        (rank, first), *others = sorted(candidates)
        if others and others[0][0] == rank:
            a, b = (table.names[index] for index in (first, others[0][1]))
            raise SubmissionError(
                f"{table.source}: {a!r} and {b!r} both look like {role}; "
                f"say which: columns = {{ {role} = {a!r} }}"
            )
        columns[role] = _column(table, first, role)
        unused += [index for _, index in others]
    return columns, tuple(table.names[index] for index in unused)


def refuse_unknown_unit(table: FileTable, column: Column, *, stated: str = "") -> None:
    """Refuse a column whose heading states a unit that is not known, or not one of a position.

    Raises
    ------
    SubmissionError : the unit is not known, or a position has the unit of another quantity. A unit
        that the submission states is accepted.
    """
    unit = column.unit
    if unit is None or unit == (unit_symbol(stated) or stated):
        return
    why = "which is not known" if not is_known_unit(unit) else ""
    if column.role[:1] == "x" and not why and not is_known(unit, position_units()):
        why = "which is no unit of a position"
    if why:
        raise SubmissionError(
            f"{table.source}: {column.name!r} states the unit {unit!r}, {why}: which unit is it? "
            "Write it in the heading, as in 'x1 [mm]'"
        )


def _unit(table: FileTable, index: int) -> str | None:
    return parse_heading(table.names[index]).unit


def _column(table: FileTable, index: int, role: str) -> Column:
    unit, name = _unit(table, index), table.names[index]
    if unit is None and role == "time" and (named := unit_symbol(plain_name(name))) in ("ms", "us"):
        unit = named  # "millis" is a name and a unit
    return Column(role=role, index=index, name=name, unit=unit)


def _role(
    plain: str, *, free: tuple[int, ...], has_time: bool, unit: str | None
) -> tuple[str | None, int]:
    """Return the role that a heading names, and the rank of the word; None without a role.

    A file with a time is no table of frequencies: there, F is a force and omega a speed.
    """
    if plain == "i" and unit is None:  # a row's number
        return None, 0
    one_cart = {f"x{free[0]}": _ONE_POSITION} if len(free) == 1 else {}
    for role, words in {**_ROLES, **one_cart}.items():
        for rank, pattern in enumerate(words):
            if re.fullmatch(pattern, plain) and not (role == "frequency" and has_time):
                return role, rank
    if match := _POSITION.fullmatch(plain):
        return f"x{next(number for number in match.groups() if number)}", 0
    return None, 0
