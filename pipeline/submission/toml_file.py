"""Read files that people typed; what is wrong with TOML is told by what stands in the line."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import BaseModel

from pipeline.errors import PipelineError, lies_in_the_file
from pipeline.submission.complaints import Location, dotted, quote, takes_numbers

Tables: TypeAlias = Mapping[str, type[BaseModel]]
Value: TypeAlias = "str | bool | int | float | Sequence[Value] | Mapping[str, Value]"
_MAX_KEY_DEPTH = 30  # tomllib's time grows with the square of a dotted key's depth
_DOTTED_KEY = re.compile(r"[\w\"'-]+(?:[ \t]*\.[ \t]*[\w\"'-]+)*")
_LONGEST_LINE, _SHOWN = 300, 60  # characters of a line that are looked at, and shown
_LONGEST_MENDED, _MOST_PASSES = 50_000, 30  # characters that are read again after a slip; times
_BEGINS = re.compile(r"\s*(#|\[|[\w\"'.-]+\s*=)")  # a line that is no rest of the one before
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


@dataclass(frozen=True, kw_only=True)
class Toml:
    """The readable part of a text, and its slips.

    Attributes
    ----------
    document : the content of the lines that can be read.
    text : those lines, each in its place; the others are empty.
    slips : (line, what is wrong) of the others, in their order. Line 0 means the whole text.
    """

    document: dict[str, Any]
    text: str
    slips: tuple[tuple[int, str], ...] = ()


def parse_toml(
    text: str,
    *,
    where: str,
    error: type[PipelineError],
    as_typed: bool = False,
    tables: Tables | None = None,
) -> dict[str, Any]:
    """Parse TOML that somebody typed.

    Parameters
    ----------
    where : what to call the file; a line's number is added.
    error : whose mistake it is.
    as_typed : leave numbers with a point or an exponent as the decimals that were typed, whatever
        their size: see `check_number`. Else they are floats that can be reckoned with.
    tables : the models of the format, by default those of a submission.

    Raises
    ------
    PipelineError : of the kind `error`; for each slip a line with its number, or the key, and what
        to write.
    """
    read = read_toml(text, as_typed=as_typed, tables=tables)
    if read.slips:
        raise error("\n".join(at_line(where, line, what) for line, what in read.slips))
    return read.document


def at_line(where: str, line: int, what: str) -> str:
    """Return what is wrong with a line of a file, or with all of it where the line is 0."""
    return f"{where} line {line}: {what}" if line else f"{where}: {what}"


def read_toml(
    text: str,
    *,
    as_typed: bool = False,
    tables: Tables | None = None,
) -> Toml:
    """Read what can be read of TOML that somebody typed: a slip hides nothing in other lines."""
    for key in _DOTTED_KEY.finditer(text):
        if key.group().count(".") > _MAX_KEY_DEPTH:
            line = text.count("\n", 0, key.start()) + 1
            return Toml(document={}, text="", slips=((line, "keys nest too deeply"),))
    typed, slips = text.split("\n"), list[tuple[int, str]]()
    lines, emptied = list(typed), -1  # the last line of the slip before
    for _ in range(_MOST_PASSES if len(text) <= _LONGEST_MENDED else 1):
        try:
            document = tomllib.loads("\n".join(lines), parse_float=_decimal)
            if not as_typed:
                document = _with_floats(document, (), slips)
            return Toml(document=document, text="\n".join(lines), slips=tuple(slips))
        except tomllib.TOMLDecodeError as wrong:
            message = " ".join(str(wrong).split())
            at = _AT.search(message)
            line = int(at[1]) if at else len(lines)
            words = _words(typed[line - 1].strip(), _AT.sub("", message), tables)
            # The rest of a list or text whose first line is gone is no mistake of its own.
            if line != emptied + 1 or _BEGINS.match(typed[line - 1]):
                shown = typed[line - 1].strip()
                shown = shown if shown.isprintable() and len(shown) <= _SHOWN else quote(shown)
                slips.append((line, f"{words}; found {shown or 'the end'}"))
            first, emptied = _spoilt(lines, line, words)
            if not any(map(str.strip, lines[first - 1 : emptied])):
                break
            lines[first - 1 : emptied] = [""] * (emptied + 1 - first)
        except RecursionError:
            slips.append((0, "lists or tables nest too deeply"))
            break
        except ValueError:  # an integer of thousands of digits
            slips.append((_long_number(text), "a number has too many digits"))
            break
    return Toml(document={}, text="", slips=tuple(slips))


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


def _with_floats(value: Any, at: tuple[int | str, ...], slips: list[tuple[int, str]]) -> Any:
    """Return a document with floats for its decimals; what can be no float is a slip, and 1."""
    if isinstance(value, dict):
        return {key: _with_floats(item, (*at, key), slips) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_floats(item, (*at, i), slips) for i, item in enumerate(value)]
    if isinstance(value, bool) or not isinstance(value, int | Decimal):
        return value
    try:
        check_number(value, at)
    except UnusableNumber as unusable:
        slips.append((0, f"{dotted(unusable.at, {})}: {unusable}"))
        return 1
    return float(value) if isinstance(value, Decimal) else value


def _long_number(text: str) -> int:
    """Return the line of the first whole number that is too long to be read, 0 without one."""
    found = _MANY_DIGITS.search(text)
    return text.count("\n", 0, found.start()) + 1 if found else 0


def _spoilt(lines: Sequence[str], line: int, words: str) -> tuple[int, int]:
    """Return the first and last line that a slip, found at `line`, takes with it."""
    if words == _UNCLOSED:
        for n in range(line - 1, 0, -1):
            if lines[n - 1].count("[") > lines[n - 1].count("]"):
                return n, line - 1
    if lines[line - 1].lstrip().startswith("["):  # its keys would go to the table before
        after = (n for n in range(line, len(lines)) if lines[n].lstrip().startswith("["))
        return line, next(after, len(lines))
    return line, line


def _words(line: str, message: str, tables: Tables | None) -> str:
    """Return what is wrong with a line, by what it looks like, else by what the parser says."""
    for said, words in _SAID:
        if re.fullmatch(said, message):
            return words
    looked_at = line[:_LONGEST_LINE]
    for slip, words, mends in _SLIPS:
        if re.search(slip, looked_at):
            key = looked_at.partition("=")[0].strip()
            if words == _TEXT and takes_numbers(key, tables):
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
