"""Read files that people typed; what is wrong with TOML is told by what stands in the line."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeAlias

from pipeline.errors import PipelineError, lies_in_the_file
from pipeline.submission.complaints import Location, dotted, quote, takes_numbers

Value: TypeAlias = "str | bool | int | float | Sequence[Value] | Mapping[str, Value]"
_MAX_KEY_DEPTH = 30  # tomllib's time grows with the square of a dotted key's depth
_DOTTED_KEY = re.compile(r"[\w\"'-]+(?:[ \t]*\.[ \t]*[\w\"'-]+)*")
_LONGEST_LINE, _SHOWN = 300, 60  # characters of a line that are looked at, and shown
_LARGEST = 30  # powers of ten: beyond any physical number in any unit, yet safe to multiply
_MOST_DIGITS = 1_000
_MOST_BITS = 100  # of a whole number: 1e30
_MANY_DIGITS = re.compile(r"(?<![\w.])[-+]?\d[\d_]{4299,}")  # Python reads 4,300 at most
_AT = re.compile(r" \(at line (\d+), column (\d+)\)$")
_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"

BACKSLASH = 'inside "…" a backslash begins a special character; folders are parted by /'
_TEXT = "text stands in quotes"
_UNCLOSED = "a list [ … ] before this line is not closed, or lacks a comma"

# What a line looks like that TOML refuses, what is wrong with it, and what in it becomes what. The
# first that fits is it; the line is shown mended where that makes it one that TOML takes.
_SLIPS: tuple[tuple[str, str, tuple[tuple[str, str], ...]], ...] = (
    (
        r"[“”„‟«»‘’‚]",
        "these are curly quotes; type straight ones",
        ((r"[“”„‟«»]", '"'), (r"[‘’‚]", "'")),
    ),
    (
        r"[\xa0\u2000-\u200f\u202f\u3000]",
        "a special space; delete it and type a plain one",
        ((r"[\xa0\u2000-\u200f\u202f\u3000]+", " "),),
    ),
    (
        r"=.*[−–—]\s*\d",
        "this is a dash; type the minus of the keyboard",
        ((r"[−–—]\s*(?=\d)", "-"),),
    ),
    (r"=\s*[-+]?\d+,\d", "a decimal comma; write a point", ((r"(\d),(\d)", r"\1.\2"),)),
    (r'"[^"]*\\', BACKSLASH, ((r"\\+", "/"),)),
    (
        r"=\s*\[?.*\b(True|TRUE|False|FALSE)\b",
        "true and false are written in small letters",
        ((r"\b(?:True|TRUE)\b", "true"), (r"\b(?:False|FALSE)\b", "false")),
    ),
    (r"^\s*(//|;|%)", "a comment begins with #", ((r"^\s*(?://|;|%)+", "#"),)),
    (r"^\s*(\[[A-Za-z][^\[\]]*\]|\[\[[^\[\]]+\]\])\s*(#.*)?$", _UNCLOSED, ()),
    (
        r"^\s*\[+\s*[A-Za-z]",
        "a table begins with [name], one of several with [[name]], in a line of its own",
        (),
    ),
    (r"^\s*[\w-]+\s*=\s*(#.*)?$", "nothing stands after the =", ()),
    (
        r"^\s*[\w-]+(\s*:|\s+[^=\s])",
        "between a name and its value stands a =",
        ((r"^(\s*[\w-]+)\s*:?\s*", r"\1 = "),),
    ),
    (
        r"=\s*[-+]?\.\d|=\s*[-+]?\d+\.(?!\d)",
        "a point has digits on both sides",
        ((r"(?<!\d)\.(?=\d)", "0."), (r"(\d)\.(?!\d)", r"\1.0")),
    ),
    (
        r"=\s*[-+]?0\d",
        "a number begins with no 0 but that of 0.5",
        ((r"(=\s*[-+]?)0+(?=\d)", r"\1"),),
    ),
    (
        rf"=\s*{_NUMBER}\s*[^]\s\d#.,}}]",
        "a number stands alone, without a unit or a sum",
        (
            (r"(\d)\s*[*·x×]\s*10\^?([-+]?\d)", r"\1e\2"),
            (rf"(=\s*{_NUMBER})\s+[A-Za-zµ].*", r"\1"),
        ),
    ),
    (
        r"^[^=]*=\s*[A-Za-z_./\\]",
        _TEXT,
        ((r"^([^=]*=)\s*([^#]*[^#\s])", r'\1 "\2"'),),
    ),
    (
        r"=\s*[\[{][^\"']*[\[{,\s][A-Za-z_]\w*\s*[,\]}]",
        _TEXT,
        ((r"([\[{,=]\s*)(?!true\b|false\b)([A-Za-z_]\w*)(?=\s*[,\]}])", r'\1"\2"'),),
    ),
    (r"=\s*(\"[^\"]*|'[^']*)$", "the quote is not closed", ((r"([\"'])([^\"']*)$", r"\1\2\1"),)),
)
# What tomllib says where no single line shows it.
_SAID: tuple[tuple[str, str], ...] = (
    (r"Cannot (declare|mutate|define).*", "there is such a table already; one of several, as an "
     "experiment is, begins with [[experiments]], in double brackets"),
    (r"Cannot overwrite a value|Duplicate.*", "this name has a value already, in the same table"),
    (r"Unclosed array", _UNCLOSED),
    (r"Unclosed inline table", "all of { … } stands in one line"),
)  # fmt: skip


def read_text(path: Path, *, where: str, limit: int, error: type[PipelineError]) -> str:
    """Return the text of a small UTF-8 file; a byte-order mark is dropped.

    Parameters
    ----------
    where : what to call the file.
    limit : bytes.
    error : whose mistake it is.

    Raises
    ------
    PipelineError : of the kind `error`, where it is too large or no such text; one line.
    OSError : this computer cannot read it now, whatever is in it.
    """
    try:
        if (size := path.stat().st_size) > limit:
            raise error(_too_large(where, size, limit))
        raw = path.read_bytes()
    except OSError as wrong:
        if not lies_in_the_file(wrong):
            raise
        raise error(f"{where}: cannot be read ({wrong.strerror})") from None
    return decoded(raw, where=where, limit=limit, error=error)


def decoded(raw: bytes, *, where: str, limit: int, error: type[PipelineError]) -> str:
    """Return what `read_text` does of a file that holds `raw`."""
    if len(raw) > limit:
        raise error(_too_large(where, len(raw), limit))
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as wrong:
        line = raw[: wrong.start].count(b"\n") + 1
        raise error(f"{where} line {line}: not UTF-8 text; save it as UTF-8") from None


def _too_large(where: str, size: int, limit: int) -> str:
    return f"{where}: {size:,} bytes, the limit is {limit:,}"


def parse_toml(
    text: str,
    *,
    where: str,
    error: type[PipelineError],
    as_typed: bool = False,
) -> dict[str, Any]:
    """Parse TOML that somebody typed.

    Parameters
    ----------
    where : what to call the file; a line's number is added.
    error : whose mistake it is.
    as_typed : leave numbers with a point or an exponent as the decimals that were typed, whatever
        their size: see `number_problem`. Else they are floats that can be reckoned with.

    Raises
    ------
    PipelineError : of the kind `error`; one line with the line's number, or the key, and what to
        write.
    """
    for key in _DOTTED_KEY.finditer(text):
        if key.group().count(".") > _MAX_KEY_DEPTH:
            line = text.count("\n", 0, key.start()) + 1
            raise error(f"{where} line {line}: keys nest too deeply")
    try:
        document = tomllib.loads(text, parse_float=_decimal)
        try:
            return document if as_typed else _with_floats(document, ())
        except UnusableNumber as unusable:
            raise error(f"{where}: {dotted(unusable.at, document)}: {unusable}") from None
    except tomllib.TOMLDecodeError as wrong:
        message = " ".join(str(wrong).split())
        at = _AT.search(message)
        line = int(at[1]) if at else text.count("\n") + 1
        typed = text.split("\n")[line - 1].strip()
        shown = typed if typed.isprintable() and len(typed) <= _SHOWN else quote(typed)
        words = _words(typed, _AT.sub("", message))
        raise error(f"{where} line {line}: {words}; found {shown or 'the end'}") from None
    except RecursionError:
        raise error(f"{where}: lists or tables nest too deeply") from None
    except ValueError:  # an integer of thousands of digits
        raise error(f"{where}{_long_number(text)}: a number has too many digits") from None


class UnusableNumber(Exception):
    """A number that nothing can be reckoned with; its text says why.

    Attributes
    ----------
    at : where it stands.
    """

    def __init__(self, at: Location, why: str) -> None:
        super().__init__(why)
        self.at = at


def check_number(value: float | Decimal, at: Location) -> None:
    """Refuse a number of a size that no quantity has, or with digits that no instrument gives.

    Raises
    ------
    UnusableNumber : it is one.
    """
    number = value if isinstance(value, int) else Decimal(value)
    if isinstance(number, Decimal) and not number.is_finite():
        raise UnusableNumber(at, f"expected a finite number, found {number}")
    # Nothing is worked out before the exponent is known to be small: some take for ever.
    sound = (
        number.bit_length() <= _MOST_BITS and abs(number) < 10**_LARGEST
        if isinstance(number, int)
        else -_LARGEST <= number.adjusted() < _LARGEST
    )
    if not sound:
        raise UnusableNumber(
            at, f"expected a number between 1e-{_LARGEST} and 1e+{_LARGEST} in size, or 0"
        )
    if isinstance(number, Decimal) and len(number.as_tuple().digits) > _MOST_DIGITS:
        raise UnusableNumber(at, f"expected a number of at most {_MOST_DIGITS} digits")


def _decimal(text: str) -> Decimal:
    """Return a number as it was typed; for an exponent that no decimal holds, an unusable one."""
    try:
        return Decimal(text)
    except InvalidOperation:
        return Decimal((0, (1,), 10 * _LARGEST))


def _with_floats(value: Any, at: tuple[int | str, ...]) -> Any:
    """Return a document with floats for its decimals.

    Raises
    ------
    UnusableNumber : one of its numbers can be no float.
    """
    if isinstance(value, dict):
        return {key: _with_floats(item, (*at, key)) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_floats(item, (*at, i)) for i, item in enumerate(value)]
    if isinstance(value, bool) or not isinstance(value, int | Decimal):
        return value
    check_number(value, at)
    return float(value) if isinstance(value, Decimal) else value


def _long_number(text: str) -> str:
    """Return " line 7" for the first whole number that is too long to be read, or ""."""
    found = _MANY_DIGITS.search(text)
    return f" line {text.count(chr(10), 0, found.start()) + 1}" if found else ""


def _words(line: str, message: str) -> str:
    """Return what is wrong with a line, by what it looks like, else by what the parser says."""
    for said, words in _SAID:
        if re.fullmatch(said, message):
            return words
    looked_at = line[:_LONGEST_LINE]
    for slip, words, mends in _SLIPS:
        if re.search(slip, looked_at):
            key = looked_at.partition("=")[0].strip()
            if words == _TEXT and takes_numbers(key):
                return f"{key} takes a number, written in digits"
            return words + _mended(looked_at, mends)
    return f"not valid TOML: {message}"


def _mended(line: str, mends: tuple[tuple[str, str], ...]) -> str:
    """Return ": write …" with the line as it should be; "" where that is not known."""
    new = line
    for pattern, put in mends:
        new = re.sub(pattern, put, new)
    try:
        tomllib.loads(new)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return ""
    return f": write {new}" if new != line and new.isprintable() and len(new) <= _SHOWN else ""
