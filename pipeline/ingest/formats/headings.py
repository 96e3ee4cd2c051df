"""What a heading says: the name of a column, its unit, and the run that it belongs to."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

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

    @property
    def has_known_unit(self) -> bool:
        """Whether the unit is known, or not stated."""
        return self.unit is None or is_known_unit(self.unit)


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
        if unit is None and (not held or (not square and _LABEL.fullmatch(held))):
            continue
        if len(held) > _LONGEST or (unit is None and held.count(" ") > 1):
            continue
        name = f"{rest[: bracket.start()]} {rest[bracket.end() :]}"
        return Heading(name=_tidy(name), unit=unit or held, run=run)
    for mark, any_word in ((" / ", True), ("/", True), (" in ", True), (",", False), (" ", False)):
        name, found, last = rest.rpartition(mark)
        unit = unit_symbol(last)
        if mark == " " and (unit is None or len(last) < 2 or last in ("in", "min", "none", "au")):
            continue
        if mark == "/" and (ratio := re.fullmatch(r"(.+?)\s*/\s*\(?([^\W\d_]+/[\w^]+)\)?", rest)):
            name, last = ratio[1], ratio[2]
            unit = unit_symbol(last)
            if unit is None and not is_known_unit(last):
                name, _, last = rest.rpartition("/")
                unit = unit_symbol(last)
        word = any_word and re.fullmatch(r"[^\W\d_°%][^\W\d_]{0,19}[²2]?", last.strip())
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
