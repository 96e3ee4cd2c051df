"""Read TOML files that people typed; explain a mistake from the content of its line."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pydantic import BaseModel

from pipeline.errors import PipelineError, is_file_fault
from pipeline.resources import TEMPLATES
from pipeline.submission.complaints import Location, dotted, quote, takes_numbers
from pipeline.submission.models import Submission

Value: TypeAlias = "str | bool | int | float | Sequence[Value] | Mapping[str, Value]"
_LONGEST_LINE, _SHOWN = 300, 60  # characters of a line that are checked, and that are shown
# exponent; larger than that of any physical number, yet numbers can still be multiplied
_LARGEST = 30
_AT = re.compile(r" \(at line (\d+), column (\d+)\)$")
_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\],\s](?:[^\[\],]*[^\[\],\s])?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"\s*([A-Za-z0-9_.\"'-]+)\s*=")
_QUOTED = re.compile(r"\"(?:\\.|[^\"\\\n])*\"|'[^'\n]*'")
_KEYS = re.compile(rf"(?:[\w-]+|{_QUOTED.pattern})(?:[ \t]*\.[ \t]*(?:[\w-]+|{_QUOTED.pattern}))*")
# A heading, even if a bracket of it is missing; not a row of numbers in a longer list.
_HEADING = re.compile(
    r"\s*(?:\[+\s*|(?=[^=]*\]\s*(?:#.*)?$)|\W+(?=reported\b))([A-Za-z_\"'][^,=\[\]()]*)[^,=]*$"
)
_NAME = re.compile(r"\s*([^\W\d][\w.-]*)")  # the name at the beginning of a line


@dataclass(frozen=True, kw_only=True)
class _Slip:
    """A typing mistake in TOML; see templates/toml_slips.toml."""

    words: str
    parser: str = ""
    line: str = ""
    code: str = ""
    mends: Sequence[Sequence[str]] = ()


def read_text(path: Path, *, where: str, limit: int, error: type[PipelineError]) -> str:
    """Return the text of a small UTF-8 file without its byte-order mark.

    Parameters
    ----------
    where : name of the file in messages.
    limit : largest size in bytes.
    error : class of error to raise for a fault of the file.

    Raises
    ------
    PipelineError : the file is too large or not UTF-8. The error is of class `error`; its message
        has one line.
    OSError : the computer cannot read the file now, whatever its content.
    """
    try:
        if (size := path.stat().st_size) > limit:
            raise error(_too_large(where, size, limit))
        raw = path.read_bytes()
    except OSError as wrong:
        if not is_file_fault(wrong):
            raise
        raise error(f"{where}: cannot be read ({wrong.strerror})") from None
    return decoded(raw, where=where, limit=limit, error=error)


def decoded(raw: bytes, *, where: str, limit: int, error: type[PipelineError]) -> str:
    """Return the result of `read_text` for a file that holds `raw`."""
    if len(raw) > limit:
        raise error(_too_large(where, len(raw), limit))
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as wrong:
        line = raw[: wrong.start].count(b"\n") + 1
        raise error(f"{where} line {line}: not UTF-8 text; save it as UTF-8") from None


def _too_large(where: str, size: int, limit: int) -> str:
    return f"{where}: {size:,} bytes, the limit is {limit:,}"


class TomlSlip(NamedTuple):
    """A mistake in a TOML text.

    Attributes
    ----------
    line : number of the line that is not readable; 0 means the whole text.
    what : what is wrong, and what to write instead.
    spoilt : the keys and tables that cannot be read because of it; empty if this is not known.
    """

    line: int
    what: str
    spoilt: tuple[Location, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Toml:
    """The readable part of a TOML text, and its mistakes (slips).

    Attributes
    ----------
    document : the content of the readable lines.
    text : the readable lines, each in its place; all other lines are empty.
    """

    document: dict[str, Any]
    text: str
    slips: tuple[TomlSlip, ...] = ()


def parse_toml(
    text: str,
    *,
    where: str,
    error: type[PipelineError],
    as_typed: bool = False,
    root: type[BaseModel] = Submission,
) -> dict[str, Any]:
    """Parse TOML that somebody typed.

    Parameters
    ----------
    where : name of the file in messages. A line's number is added.
    error : class of error to raise for a mistake.
    as_typed : whether to keep numbers with a point or an exponent as decimals instead of floats.
        Decimals can have any size; see `check_number`.
    root : the model of the format.

    Raises
    ------
    PipelineError : of class `error`. Each line of the message names the place of a mistake, and
        says what to write instead.
    """
    read = read_toml(text, as_typed=as_typed, root=root)
    if read.slips:
        raise error("\n".join(at_line(where, slip.line, slip.what) for slip in read.slips))
    return read.document


def at_line(where: str, line: int, what: str) -> str:
    """Return a fault with its place: a line of the file, or the whole file if `line` is 0."""
    return f"{where} line {line}: {what}" if line else f"{where}: {what}"


def read_toml(
    text: str,
    *,
    as_typed: bool = False,
    root: type[BaseModel] = Submission,
) -> Toml:
    """Read the valid lines of typed TOML; a mistake in one line does not hide the others."""
    if line := find_deep_key(text):
        return Toml(document={}, text="", slips=(TomlSlip(line, "keys nest too deeply"),))
    typed, slips = text.split("\n"), list[TomlSlip]()
    lines, emptied = list(typed), -1  # last line of the previous mistake
    for _ in range(30 if len(text) <= 50_000 else 1):  # a long text is read only once
        try:
            document = tomllib.loads("\n".join(lines), parse_float=_decimal)
            if not as_typed:
                document = _with_floats(document, (), slips)
            return Toml(document=document, text="\n".join(lines), slips=tuple(slips))
        except tomllib.TOMLDecodeError as wrong:
            message = " ".join(str(wrong).split())
            at = _AT.search(message)
            line = int(at[1]) if at else len(lines)
            shown = typed[line - 1].strip()
            slip = _find_slip(shown, _AT.sub("", message))
            # The rest of a list or text with a bad first line is not a second mistake.
            begins = re.match(r"\s*(#|\[|[\w\"'.-]+\s*=)", typed[line - 1])
            told = line != emptied + 1 or begins
            first, emptied = _find_spoilt(lines, line, slip)
            if told:
                spoilt = tuple(_spoilt_keys(typed, first, emptied))
                numbers = root is Submission and spoilt[0][:1] == ("reported",)
                words = _explain_slip(slip, shown, root, numbers=numbers)
                shown = shown if shown.isprintable() and len(shown) <= _SHOWN else quote(shown)
                slips.append(TomlSlip(line, f"{words}; found {shown or 'the end'}", spoilt))
            if not any(map(str.strip, lines[first - 1 : emptied])):
                break
            lines[first - 1 : emptied] = [""] * (emptied + 1 - first)
        except RecursionError:
            slips.append(TomlSlip(0, "lists or tables nest too deeply"))
            break
        except ValueError:  # an integer of thousands of digits
            line = _long_number("\n".join(lines))
            spoilt = tuple(_spoilt_keys(typed, line, line)) if line else ()
            slips.append(TomlSlip(line, "a number has too many digits", spoilt))
            if not line:
                break
            lines[line - 1] = ""
    return Toml(document={}, text="", slips=tuple(slips))


class UnusableNumber(Exception):
    """A number that cannot be computed with; its text says why.

    Attributes
    ----------
    at : the place of the number in the file.
    """

    def __init__(self, at: Location, why: str) -> None:
        super().__init__(why)
        self.at = at


def check_number(value: float | Decimal, at: Location) -> None:
    """Refuse a number of an impossible size, or with more digits than any instrument gives.

    Raises
    ------
    UnusableNumber : the number is refused.
    """
    number = value if isinstance(value, int) else Decimal(value)
    if isinstance(number, Decimal) and not number.is_finite():
        raise UnusableNumber(at, f"expected a finite number, found {number}")
    # Check the exponent before any computation, since computing with a huge one never ends.
    sound = (
        number.bit_length() <= 100 and abs(number) < 10**_LARGEST
        if isinstance(number, int)
        else -_LARGEST <= number.adjusted() < _LARGEST
    )
    if not sound:
        raise UnusableNumber(
            at, f"expected a number between 1e-{_LARGEST} and 1e+{_LARGEST} in size, or 0"
        )
    if isinstance(number, Decimal) and len(number.as_tuple().digits) > 1_000:
        raise UnusableNumber(at, "expected a number of at most 1000 digits")


def find_deep_key(text: str) -> int:
    """Return the line of a key with more than thirty parts; 0 if no key has.

    `tomllib` takes time with the square of the number of parts.
    """
    for key in _KEYS.finditer(text):
        if key.group().count(".") > 30 and _QUOTED.sub("", key.group()).count(".") > 30:
            return text.count("\n", 0, key.start()) + 1
    return 0


def _decimal(text: str) -> Decimal:
    """Return a number as typed; if its exponent is too large, one that `check_number` refuses."""
    try:
        return Decimal(text)
    except InvalidOperation:
        return Decimal((0, (1,), 10 * _LARGEST))


def _with_floats(value: Any, at: tuple[int | str, ...], slips: list[TomlSlip]) -> Any:
    """Return a document with floats in place of decimals.

    A number that is too large is added to `slips` and becomes 1.
    """
    if isinstance(value, dict):
        return {key: _with_floats(item, (*at, key), slips) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_floats(item, (*at, i), slips) for i, item in enumerate(value)]
    if isinstance(value, bool) or not isinstance(value, int | Decimal):
        return value
    try:
        check_number(value, at)
    except UnusableNumber as unusable:
        slips.append(TomlSlip(0, f"{dotted(unusable.at, {})}: {unusable}"))
        return 1
    return float(value) if isinstance(value, Decimal) else value


def _long_number(text: str) -> int:
    """Return the line of the first whole number that is too long to read; 0 if all are short."""
    found = re.search(r"(?<![\w.])[-+]?\d[\d_]{4299,}", text)  # Python reads at most 4,300 digits
    return text.count("\n", 0, found.start()) + 1 if found else 0


def _find_spoilt(lines: Sequence[str], line: int, slip: _Slip) -> tuple[int, int]:
    """Return the first and last line that a slip at `line` makes unreadable."""
    if slip.code == "unclosed_list":
        for n in range(line - 1, 0, -1):
            if lines[n - 1].count("[") > lines[n - 1].count("]"):
                return n, line - 1
    if _heading(lines[line - 1]):  # otherwise the previous table would get its keys
        after = (n for n in range(line, len(lines)) if lines[n].lstrip().startswith("["))
        return line, next(after, len(lines))
    return line, line


def _heading(line: str) -> re.Match[str] | None:
    """Return the heading in a line, even a spoilt one; a very long line is not one."""
    return _HEADING.match(line) if len(line) <= _LONGEST_LINE else None


def _spoilt_keys(lines: list[str], first: int, last: int) -> Iterator[Location]:
    """Yield the table or the keys in some lines.

    A line that begins with neither a heading nor a name belongs to the key above it.
    """
    if heading := _heading(lines[first - 1]):
        yield tuple(re.split(r"[\s.]+", heading[1].strip(" \"'\r")))
        return
    places: list[tuple[Location, int]] = [((), 0)]
    places += [(at, number) for number, at in key_lines("\n".join(lines[:last]))]
    above = [(at, number) for at, number in places if number <= first]
    name = _NAME.match(lines[first - 1])
    if name and above[-1][1] < first:
        headings = (at for at, n in reversed(above) if not n or _HEADER.match(lines[n - 1]))
        yield (*next(headings), *name[1].split("."))
    else:
        yield above[-1][0]
    yield from (at for at, number in places if number > first)


def key_lines(text: str) -> Iterator[tuple[int, tuple[int | str, ...]]]:
    """Yield line and path of every table heading, and of every key at the beginning of a line."""
    table: tuple[int | str, ...] = ()
    counts: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            keys = tuple(part.strip(" \"'") for part in header[2].split("."))
            table = keys
            if header[1] == "[[":
                counts[header[2]] = counts.get(header[2], -1) + 1
                table = (*keys, counts[header[2]])
            yield number, table
        elif key := _KEY.match(line):
            yield number, (*table, *(part.strip("\"'") for part in key[1].split(".")))


def _find_slip(line: str, message: str) -> _Slip:
    """Return the mistake in a line, found from its form or from the parser's message."""
    for slip in _slips():
        if slip.parser and re.fullmatch(slip.parser, message):
            return slip
        if slip.line and re.search(slip.line, line[:_LONGEST_LINE]):
            return slip
    return _Slip(words=f"not valid TOML: {message}")


def _explain_slip(slip: _Slip, line: str, root: type[BaseModel], *, numbers: bool) -> str:
    """Return what is wrong, with ": write …" and the corrected line if it is known.

    Parameters
    ----------
    numbers : whether the table of the line takes only numbers.
    """
    line = line[:_LONGEST_LINE]
    key = line.partition("=")[0].strip()
    if slip.code == "unquoted_text" and (numbers or takes_numbers(key, root)):
        return f"{key} takes a number, written in digits"
    new = line
    for pattern, put in slip.mends:
        new = re.sub(pattern, put, new)
    try:
        tomllib.loads(new)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return slip.words
    mended = new != line and new.isprintable() and len(new) <= _SHOWN
    return f"{slip.words}: write {new}" if mended else slip.words


@cache
def _slips() -> tuple[_Slip, ...]:
    text = (TEMPLATES / "toml_slips.toml").read_text(encoding="utf-8")
    return tuple(_Slip(**row) for row in tomllib.loads(text)["slips"])


def backslash_words() -> str:
    """Return the sentence about a backslash in quotes."""
    return next(slip.words for slip in _slips() if slip.code == "backslash")
