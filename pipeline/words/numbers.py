"""Write numbers and lists in the same way on every page."""

import math
import re
from collections.abc import Iterable, Sequence

_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_SUBSCRIPT = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_PLAIN_RANGE = (1e-3, 1e5)  # numbers of this size are written without a power of ten
_MOST_DIGITS = 5
_FINEST = 1e-8  # a smaller relative error belongs to exact data and is not told
_ONE_DIGIT = 1e-3  # a smaller relative error has one digit
SMALL_ERROR = 1e-4  # a smaller relative error is only told to be so: no calibration is that good
NOTHING = "–"
_TIMES = " × 10"
_WHOLE = re.compile(r"[^\w]*\d+(?=\D|$)")
_EXPONENT = re.compile(r"(?<![\w.])(-?\d+(?:\.\d+)?)e([+-]\d+)\b")
_HYPHEN = re.compile(r"(?<![\w.)\]])-(?=\d)")
# A space next to ± or ×, before % or °, or between a number and its unit.
_JOINT = re.compile(
    r"(?<=[\d⁰¹²³⁴-⁹)]) (?=[±×%°σ]|(?:(?:[kmµ]?(?:Hz|V|A|N|g|m|s)|cm|rad|dB|min|h|counts?)\b))"
    r"|(?<=[±×<]) (?=[\d(<])"
)
_SIGNED_ZERO = re.compile(r"[+−]0\.0 %")


def significant(value: float | None, *, digits: int = 4, power: bool = False) -> str:
    """Return a number with `digits` significant digits; a dash for a missing number."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    exponent = _exponent(value, digits=digits)
    if _is_plain(exponent) and not power:
        return _fixed(value, digits - 1 - exponent)
    return f"{_fixed(value / 10.0**exponent, digits - 1)}{_TIMES}{_superscript(exponent)}"


def with_errors(column: Sequence[tuple[float, float | None]]) -> list[str]:
    """Return "value ± std" for each pair; if one text needs a power of ten, all have one."""
    texts = [with_error(value, std) for value, std in column]
    if not any(_TIMES in text for text in texts):
        return texts
    return [with_error(value, std, power=True) for value, std in column]


def with_error(value: float, std: float | None, *, digits: int = 2, power: bool = False) -> str:
    """Return "value ± std", rounded to `digits` digits of the standard error.

    An error below 0.1 % of the value has one digit; one below 0.01 % is written "± < 0.01 %". A
    power of ten is used if the number is very large or very small, or if `power` is true.
    """
    if std is None or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return significant(value, power=power)
    if std < SMALL_ERROR * abs(value):
        text = significant(value, digits=_MOST_DIGITS, power=power)
        return text if std < _FINEST * abs(value) else f"{text} ± {share(std / abs(value))}"
    if std < _ONE_DIGIT * abs(value):
        digits = 1
    size = _exponent(max(abs(value), std), digits=2)
    if _is_plain(size) and not power:
        decimals = digits - 1 - _exponent(std, digits=digits)
        return f"{_fixed(value, decimals)} ± {_fixed(std, decimals)}"
    scale = 10.0**size
    decimals = digits - 1 - _exponent(std / scale, digits=digits)
    inside = f"{_fixed(value / scale, decimals)} ± {_fixed(std / scale, decimals)}"
    return f"({inside}){_TIMES}{_superscript(size)}"


def share(ratio: float) -> str:
    """Return a share as a percentage with at most two digits; a very small one as "< 0.01 %"."""
    if ratio < SMALL_ERROR:
        return "< 0.01 %"
    return f"{significant(100 * ratio, digits=2 if ratio >= 0.001 else 1)} %"


def complex_text(value: complex, *, digits: int) -> str:
    """Return "−1.2 + 3.4 j", or only the real part if the number is real."""
    real = significant(value.real, digits=digits)
    if value.imag == 0:
        return real
    sign = "+" if value.imag > 0 else "−"
    return f"{real} {sign} {significant(abs(value.imag), digits=digits)} j"


def percent(value: float | None, *, signed: bool = False) -> str:
    """Return a percentage, with one decimal below 100 % and no decimals above."""
    if value is None or not math.isfinite(value):
        return NOTHING
    text = _fixed(value, 1 if abs(value) < 99.95 else 0)
    return f"+{text} %" if signed and value > 0 and text != "0.0" else f"{text} %"


def at_decimal(text: str) -> tuple[str, str]:
    """Return a written number in two parts, cut before its decimal mark: "−1", ".4 % (1.6 σ)"."""
    match = _WHOLE.match(text)
    return (match[0], text[match.end() :]) if match else (text, "")


def typeset(text: str) -> str:
    """Return a sentence with real minus signs and powers of ten, and without signed zeros."""
    text = _EXPONENT.sub(lambda m: f"{m[1]} × 10{_superscript(int(m[2]))}", text)
    text = _HYPHEN.sub("−", text)
    return _SIGNED_ZERO.sub("0.0 %", text)


def count(n: int, noun: str) -> str:
    """Return a number with its noun: "1 decay", "3 decays"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def listing(items: Sequence[str], *, most: int | None = None) -> str:
    """Return "a", "a and b", "a, b and c"; items beyond `most` are only counted: "a and 3 more"."""
    if most is not None and len(items) > most:
        items = [*items[:most], f"{len(items) - most} more"]
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} and {items[-1]}"


def first_few(names: Sequence[str], most: int) -> str:
    """Return "a, b, c"; names beyond `most` are only counted: "a, b and 3 more"."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def join_names(ids: Sequence[str], *, most: int = 4) -> str:
    """Return names; if there are more than `most`, leave out the middle: "a, b … z (9 in all)"."""
    if len(ids) <= most:
        return ", ".join(ids)
    return f"{ids[0]}, {ids[1]} … {ids[-1]} ({len(ids)} in all)"


def group_messages(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Return a sentence for each different note, beginning with the names of its items."""
    about: dict[str, list[str]] = {}
    for name, note in notes:
        if note:
            about.setdefault(note, []).append(name)
    return [f"{join_names(list(dict.fromkeys(names)))}: {note}" for note, names in about.items()]


def subscript(n: int) -> str:
    """Return a number as an index in plain text: "₁" for 1."""
    return str(n).translate(_SUBSCRIPT)


def unit_text(unit: str) -> str:
    """Return a unit with raised powers and no-break spaces: "V s^2/cm" as "V s²/cm"."""
    return unit.replace("^2", "²").replace("^3", "³").replace(" ", "\u00a0")


def unbroken(text: str) -> str:
    """Return a text in which numbers stay on one line with their errors, powers and units."""
    return _JOINT.sub("\u00a0", text)


def _exponent(value: float, *, digits: int) -> int:
    """Return the power of ten of `value` once it is rounded to `digits` digits."""
    return int(f"{abs(value):.{digits - 1}e}".split("e")[1])


def _is_plain(exponent: int) -> bool:
    low, high = _PLAIN_RANGE
    return low <= 10.0**exponent < high


def _fixed(value: float, decimals: int) -> str:
    rounded = round(value, decimals) + 0.0  # + 0.0 turns -0.0 into 0.0
    return f"{rounded:.{max(decimals, 0)}f}".replace("-", "−")


def _superscript(exponent: int) -> str:
    return str(exponent).translate(_SUPERSCRIPT)
