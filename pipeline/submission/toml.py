"""Read and write TOML files that people type; explain each fault in a line, with its cure."""

import json
import re
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline.errors import PipelineError, is_file_fault
from pipeline.resources import TEMPLATES
from pipeline.submission.models import Submission
from pipeline.words.numbers import first_few

Location = Sequence[int | str]

_LONGEST_QUOTE = 60  # most characters shown of a found value
MOST_LISTED = 20  # most faults listed for a file; finding the nearest valid key takes a while
_MOST_KNOWN = 40  # most valid values listed

# Descriptions of expected values, by pydantic's name for the error.
_EXPECTED = {
    "string_type": "text in quotes",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "tuple_type": "a list [ … ]",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "is_instance_of": "a number",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "too_long": "at most {max_length} values",
    "too_short": "at least {min_length} values",
    "string_too_long": "at most {max_length} characters",
    "string_pattern_mismatch": "one line of printable characters",
    "literal_error": "{expected}",
    "union_tag_invalid": "type = {expected_tags}",
    "union_tag_not_found": 'type = "state_feedback" or "pid"',
}


def quote(value: object) -> str:
    """Return a found value as one short printable line."""
    if isinstance(value, Decimal):
        text = str(value)
    else:
        text = _summary(value) if isinstance(value, dict | tuple | list) else repr(value)
    return text if len(text) <= _LONGEST_QUOTE else text[: _LONGEST_QUOTE - 1] + "…"


def _summary(value: dict | tuple | list) -> str:
    if isinstance(value, dict):
        return "a table"
    if len(value) > 4:
        return f"a list of {len(value)}"
    return f"[{', '.join(quote(item) for item in value)}]"


def nearest(name: object, candidates: Sequence[str]) -> str:
    """Return "; did you mean …?" or, if no candidate is similar, the first few candidates."""
    typed = str(name)[:_LONGEST_QUOTE]
    close = [one for one in candidates if _plain_name(one) == _plain_name(typed)]
    close = close or get_close_matches(typed, candidates, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {first_few(candidates, _MOST_KNOWN)}" if candidates else ""


def _plain_name(name: str) -> str:
    """Return a name in lower case, without the leading zeros of its numbers."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name.casefold())


def list_keys(root: type[BaseModel], table: Location = ()) -> tuple[str, ...]:
    """Return the keys allowed in a table of a format, with pydantic's path of the table."""
    models = [root]
    for part in table:
        fields = [model.model_fields.get(str(part)) for model in models]
        below = [kind for field in fields if field for kind in _models(field.annotation)]
        models = below or [one for one in models if part in _tags(one)] or models
    fields = {name: one for model in models for name, one in model.model_fields.items()}
    return tuple(name for name, field in fields.items() if not field.exclude)


def takes_numbers(key: str, root: type[BaseModel]) -> bool:
    """Return whether a key holds numbers and never text, in any table of a format."""
    kinds, models = set[object](), [root]
    for model in models:  # the list grows
        for name, field in model.model_fields.items():
            models += _models(field.annotation)
            kinds |= set(_kinds(field.annotation)) if name == key else set()
    return bool(kinds & {int, float, Decimal}) and str not in kinds


def _kinds(annotation: object) -> Iterator[object]:
    """Yield the plain types of an annotation."""
    inner = get_args(annotation)
    if not inner:
        yield annotation
    for one in inner:
        yield from [type(one)] if get_origin(annotation) is Literal else _kinds(one)


def _models(annotation: object) -> list[type[BaseModel]]:
    """Return the tables that an annotation allows."""
    return [
        kind
        for kind in _kinds(annotation)
        if isinstance(kind, type) and issubclass(kind, BaseModel)
    ]


def _tags(model: type[BaseModel]) -> list[object]:
    """Return the values that select this variant of a table."""
    return [tag for field in model.model_fields.values() for tag in get_args(field.annotation)]


def dotted(location: Location, document: object) -> str:
    """Return a place such as `experiments[2].kind (step-a)`.

    Lists count from 1, and experiments also have their id.
    """
    path, here, name = "", document, ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part + 1}]"
        else:
            path += ("." if path else "") + (
                part if re.fullmatch(r"[A-Za-z0-9_-]{1,40}", part) else quote(part)
            )
        here = _below(here, part)
        if isinstance(here, dict) and isinstance(part, int) and isinstance(here.get("id"), str):
            name = f" ({quote(here['id'])[1:-1]})"
    return path + name


def explain(error: ErrorDetails, document: dict, *, root: type[BaseModel] = Submission) -> str:
    """Return one pydantic error as `key: what was expected, what was found, what was meant`.

    `root` is the model of the format.
    """
    location = [part for part in error["loc"] if not isinstance(part, str) or part != "str"]
    location = without_tag(location, document)
    where, found, kind = dotted(location, document), error["input"], error["type"]
    if kind == "missing":
        return f"{where}: is required and missing"
    if kind == "extra_forbidden":
        return f"{where}: unknown key{nearest(location[-1], list_keys(root, error['loc'][:-1]))}"
    text = f"{where}: {refusal(error)}"
    if kind == "tuple_type" and isinstance(found, dict):
        text += f"; start each with [[{where}]], in double brackets"
    context = error.get("ctx", {})
    typed = context["tag"] if kind == "union_tag_invalid" else found
    if kind in ("literal_error", "union_tag_invalid") and isinstance(typed, str):
        valid = str(context.get("expected") or context.get("expected_tags"))
        close = get_close_matches(typed, re.findall(r"'([^']*)'", valid), n=1)
        text += f"; did you mean {close[0]!r}?" if close else ""
    return text


def first_refusal(error: ValidationError) -> str:
    """Return the first fault of a file written by another program, with its place."""
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {refusal(first)}" if where else refusal(first)


def refusal(error: ErrorDetails) -> str:
    """Return what was expected and what was found, for one pydantic error."""
    kind, found = error["type"], quote(error["input"])
    if kind == "union_tag_invalid":  # the input is the whole table
        found = quote(error.get("ctx", {})["tag"])
    if kind == "json_invalid":
        return "not JSON, or truncated"
    if kind == "value_error":  # its message says what was found
        return error["msg"].removeprefix("Value error, ").rstrip(".")
    if kind not in _EXPECTED:
        return f"{error['msg']}, found {found}"
    return f"expected {_EXPECTED[kind].format(**error.get('ctx', {}))}, found {found}"


def relevant_errors(errors: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Return the errors, unknown keys first.

    A missing key is left out if an unknown key is likely the same key, misspelt.
    """
    unknown = [error for error in errors if error["type"] == "extra_forbidden"]

    def is_misspelt(error: ErrorDetails) -> bool:
        *table, key = error["loc"]
        typed = [str(one["loc"][-1]) for one in unknown if [*one["loc"][:-1]] == table]
        return bool(get_close_matches(str(key), typed[:_MOST_KNOWN], n=1))

    others = [error for error in errors if error["type"] != "extra_forbidden"]
    return [*unknown, *(e for e in others if e["type"] != "missing" or not is_misspelt(e))]


def list_faults(where: str, problems: Sequence[str]) -> str:
    """Return the first faults of a file, one line each."""
    return "\n".join(f"{where}: {what}" for what in problems[:MOST_LISTED])


def without_tag(location: Location, document: object) -> list[int | str]:
    """Return a location without the names that pydantic adds for variants of a table.

    These names are not keys of the file.
    """
    kept: list[int | str] = []
    here = document
    for i, part in enumerate(location):
        selected = isinstance(here, dict) and part in here.values() and part not in here
        if selected and i < len(location) - 1:
            continue
        kept.append(part)
        here = _below(here, part)
    return kept


def _below(value: Any, part: int | str) -> Any:
    """Return what a table or list holds at a key or index; None if it holds nothing there."""
    try:
        return value[part]
    except (KeyError, IndexError, TypeError):
        return None


# ------------------------------------------------------------------------------------------ reading

Value: TypeAlias = "str | bool | int | float | Sequence[Value] | Mapping[str, Value]"
_LONGEST_LINE, _SHOWN = 300, 60  # characters of a line that are checked, and that are shown
# exponent; larger than that of any physical number, yet numbers can still be multiplied
_LARGEST = 30
_AT = re.compile(r" \(at line (\d+), column (\d+)\)$")
_QUOTED = re.compile(r"\"(?:\\.|[^\"\\\n])*\"|'[^'\n]*'")
_KEYS = re.compile(rf"(?:[\w-]+|{_QUOTED.pattern})(?:[ \t]*\.[ \t]*(?:[\w-]+|{_QUOTED.pattern}))*")
# A heading, even if a bracket of it is missing; not a row of numbers in a longer list.
_HEADING = re.compile(
    r"\s*(?:\[+\s*|(?=[^=]*\]\s*$)|\W+(?=(?:reported|system|design|experiments)\b))([A-Za-z_\"'][^,=\[\]()]*)[^,=]*$"
)
_PART = re.compile(rf"{_QUOTED.pattern}|[\w-]+")
# The name at the beginning of a line, and = if it is there.
_NAME = re.compile(r"\s*[\"']?([^\W\d][\w.-]*)[\"']?(?:[^\W\d]|[ \t])*([=:]?)")
_QUOTES = "\"'“”„‟«»‘’‚"
# A name and one number in any form that people type, with single spaces. A unit that changes its
# size is not allowed.
_ONE_NUMBER = re.compile(
    rf" ?(?P<key>[^\s=:]+(?:[ ][^\W\d]\w*)?)(?: ?[=:] ?| )[{_QUOTES}]* ?(?P<sign>[-+−–—]?) ?"
    r"(?P<number>\d+(?:[.,]\d*)?|[.,]\d+)"
    r"(?:(?:[eE]| ?[*·x×] ?10\^?)(?P<exponent>[-+−–—]?\d+))?\.?"
    rf"[{_QUOTES}]* ?(?:(?!m?Hz|°|deg)[A-Za-zµ][^#]*|(?:±|\+/-)[^#]*)?(?:#.*)?"
)
MOST_SPOILT = 200  # statements and tables; a file with more mistakes is refused
_DASHES = str.maketrans("−–—", "---")


@dataclass(frozen=True, kw_only=True)
class _Slip:
    """A typing mistake in TOML; see templates/toml_slips.toml."""

    words: str
    parser: str = "(?!)"  # matches nothing
    line: str = "(?!)"
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


class TomlSlip(Exception):
    """A mistake in a TOML text; its text says what is wrong, and what to write instead.

    Attributes
    ----------
    line : number of the line that is not readable; 0 means the whole text.
    """

    def __init__(self, line: int, what: str) -> None:
        super().__init__(what)
        self.line = line


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
    as_typed : whether to keep lists, and numbers with a point or an exponent as decimals; else
        they become tuples and floats. Decimals can have any size; see `refuse_number`.
    root : the model of the format.

    Raises
    ------
    PipelineError : of class `error`. The message names the place of the first mistake, and says
        what to write instead.
    """
    try:
        return read_toml(text, as_typed=as_typed, root=root)
    except TomlSlip as slip:
        raise error(at_line(where, slip.line, str(slip))) from None


def at_line(where: str, line: int, what: str) -> str:
    """Return a fault with its place: a line of the file, or the whole file if `line` is 0."""
    return f"{where} line {line}: {what}" if line else f"{where}: {what}"


def read_toml(
    text: str, *, as_typed: bool = False, root: type[BaseModel] = Submission
) -> dict[str, Any]:
    """Return the document of a TOML text; see `parse_toml`.

    Raises
    ------
    TomlSlip : the first mistake.
    """
    document = _parse(text, root=root)
    if as_typed:
        return document
    refused: list[tuple[Location, str]] = []
    plain = plain_values(document, refused=refused)
    for at, why in refused:
        raise TomlSlip(0, f"{dotted(at, {})}: {why}")
    return plain


def _parse(text: str, *, root: type[BaseModel], numbers: bool = False) -> dict[str, Any]:
    """Return a document with decimals in place of floats.

    Parameters
    ----------
    numbers : whether every value of the text must be a number or a list of numbers.

    Raises
    ------
    TomlSlip : the first mistake.
    """
    if line := find_deep_key(text):
        raise TomlSlip(line, "keys nest too deeply")
    try:
        return tomllib.loads(text, parse_float=_decimal)
    except tomllib.TOMLDecodeError as wrong:
        message = " ".join(str(wrong).split())
        at = _AT.search(message)
        lines = text.split("\n")
        line = int(at[1]) if at else 1 if numbers else len(lines)
        shown = lines[line - 1].strip()
        words = _explain_slip(shown, _AT.sub("", message), root, numbers=numbers)
        shown = shown if shown.isprintable() and len(shown) <= _SHOWN else quote(shown)
        raise TomlSlip(line, f"{words}; found {shown or 'the end'}") from None
    except RecursionError:
        raise TomlSlip(0, "lists or tables nest too deeply") from None
    except ValueError:  # an integer of thousands of digits
        raise TomlSlip(_long_number(text), "a number has too many digits") from None


@dataclass
class Statement:
    """A heading, or a key with its value, as typed in one or more lines of a file.

    Attributes
    ----------
    line : number of the first line.
    table, at : keys of the table above, and of the statement itself. A table in double brackets has
        its number as the last key.
    fault : the line and the text of a mistake, if the statement cannot be read.
    """

    line: int
    table: Location
    at: Location
    is_heading: bool
    lines: list[str]
    fault: tuple[int, str] | None = None

    @property
    def text(self) -> str:
        """All lines of the statement."""
        return "\n".join(self.lines)


def split_statements(text: str) -> Iterator[Statement]:
    """Yield the headings and keys of a text, which need not be TOML.

    A line with a name begins a statement unless a list is open; a heading, or a line with "name =",
    always does. Lines without a name below a heading are a statement without a key.
    """
    one, depth = Statement(1, (), (), is_heading=False, lines=[]), 0  # of open lists
    counts: dict[Location, int] = {}
    for number, line in enumerate(text.split("\n"), start=1):
        unquoted = _QUOTED.sub(lambda found: "x" * len(found[0]), line).partition("#")[0]
        code, name = line[: len(unquoted)], _NAME.match(line[:_LONGEST_LINE])
        heading: Location = ()
        if (depth <= 0 or code.lstrip()[:1] == "[") and len(code) <= _LONGEST_LINE:
            typed = _HEADING.match(code) if code.lstrip()[:1] == "[" or "=" not in line else None
            heading = _keys(typed[1]) if typed else ()
            if heading and "[[" in code:
                counts[heading] = counts.get(heading, -1) + 1
                heading = (*heading, counts[heading])
        if heading or (name and (name[2] or depth <= 0)) or (one.is_heading and depth <= 0):
            yield one
            table = heading or one.table
            at = (*table, *_keys(name[1])) if name and not heading else table
            one, depth = Statement(number, table, at, is_heading=bool(heading), lines=[]), 0
        one.lines.append(line)
        depth += unquoted.count("[") - unquoted.count("]")
    yield one


def _keys(dotted: str) -> tuple[str, ...]:
    """Return the parts of a key or heading."""
    return tuple(part.strip("\"'") for part in _PART.findall(dotted))


def read_apart(
    text: str, table: str, *, root: type[BaseModel] = Submission
) -> tuple[dict[str, Any], Sequence[Statement]]:
    """Read typed TOML; a mistake in a statement of one table costs only this statement.

    All values of the table must be numbers or lists of numbers. A heading that cannot be read costs
    the statements below it.

    Returns
    -------
    the document, and the statements of the table; those with a `fault` are not in the document.

    Raises
    ------
    TomlSlip : the first mistake outside the table, or a table with very many mistakes.
    """
    statements = list(split_statements(text.replace("\r\n", "\n")))
    others = [line if one.at[:1] != (table,) else "" for one in statements for line in one.lines]
    document = _parse("\n".join(others), root=root)
    own = [one for one in statements if one.at[:1] == (table,)]
    first, is_lost, mistakes = dict[Location, Statement](), False, 0
    for one in own:
        earlier = first.setdefault(one.at, one)
        is_lost &= not one.is_heading
        if is_lost:
            continue
        try:
            value = _parse(one.text, root=root, numbers=True)
            if one.is_heading:
                is_lost = isinstance(one.at[-1], int)
            elif value and not _merge(document, one.table, value):
                key = ".".join(map(str, one.at[len(one.table) :]))
                raise TomlSlip(1, f"{key} already has a value in line {earlier.line}; keep one")
        except TomlSlip as slip:
            is_lost = one.is_heading
            line, what = max(slip.line, 1) - 1, str(slip)
            if one.at == one.table:
                what = f"expected name = number; found {quote(one.lines[line])}"
            one.fault = (one.line + line, what)
        if is_lost:
            what = "a table starts with [name] on a line of its own"
            one.fault = (one.line, f"{what}; found {one.lines[0].strip()}")
        mistakes += one.fault is not None
        if mistakes > MOST_SPOILT:
            raise TomlSlip(0, f"[{table}] has more than {MOST_SPOILT} mistakes")
    return document, own


def _merge(into: dict[str, Any], table: Location, new: Mapping[str, Any]) -> bool:
    """Add values to a table of a document; return False if a value was there already."""
    for key in table:
        into = into.setdefault(str(key), {})
        if not isinstance(into, dict):
            return False
    for key, value in new.items():
        if key not in into:
            into[key] = value
        elif not (isinstance(value, dict) and _merge(into, (key,), value)):
            return False
    return True


def mend_number(line: str) -> str:
    """Return a line with a name and one number as TOML; "" if its meaning is not certain."""
    typed = _ONE_NUMBER.fullmatch(" ".join(line[:_LONGEST_LINE].split()))
    if not typed:
        return ""
    key = unicodedata.normalize("NFKC", typed["key"].strip(_QUOTES)).replace(" ", "_")
    for letter, name in (("ω", "omega_"), ("ζ", "zeta_")):
        key = re.sub(f"{letter}_?", name, key)
    whole, point, rest = typed["number"].replace(",", ".").partition(".")
    digits = (whole.lstrip("0") or "0") + (f".{rest or 0}" if point else "")
    exponent = f"e{typed['exponent']}" if typed["exponent"] else ""
    number = (typed["sign"] + digits + exponent).translate(_DASHES)
    return f"{key} = {number}" if re.fullmatch(r"[\w-]+", key, re.ASCII) else ""


def refuse_number(value: float | Decimal) -> str:
    """Return why a number has an impossible size, or more digits than any instrument; or ""."""
    number = value if isinstance(value, int) else Decimal(value)
    if isinstance(number, int):
        sound = number.bit_length() <= 100 and abs(number) < 10**_LARGEST
    elif number.is_finite():
        # Check the exponent before any computation, since computing with a huge one never ends.
        sound = -_LARGEST <= number.adjusted() < _LARGEST
        if sound and len(number.as_tuple().digits) > 1_000:
            return "expected a number of at most 1000 digits"
    else:
        return f"expected a finite number, found {number}"
    return (
        "" if sound else f"expected a number between 1e-{_LARGEST} and 1e+{_LARGEST} in size, or 0"
    )


def find_deep_key(text: str) -> int:
    """Return the line of a key with more than thirty parts; 0 if no key has.

    `tomllib` takes time with the square of the number of parts.
    """
    for key in _KEYS.finditer(text):
        if key.group().count(".") > 30 and _QUOTED.sub("", key.group()).count(".") > 30:
            return text.count("\n", 0, key.start()) + 1
    return 0


def _decimal(text: str) -> Decimal:
    """Return a number as typed; if its exponent is too large, one that `refuse_number` refuses."""
    try:
        return Decimal(text)
    except InvalidOperation:
        return Decimal((0, (1,), 10 * _LARGEST))


def plain_values(
    value: Any, at: Location = (), *, refused: list[tuple[Location, str]], exact: str = ""
) -> Any:
    """Return lists as tuples, and decimals as floats.

    Parameters
    ----------
    at : the place of the value in the file.
    refused : gets the numbers that cannot be used, with the reason; they become None.
    exact : name of a table whose numbers all become decimals.
    """
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        below = {
            key: plain_values(item, (*at, key), refused=refused, exact=exact) for key, item in pairs
        }
        return below if isinstance(value, dict) else tuple(below.values())
    if isinstance(value, bool) or not isinstance(value, int | Decimal):
        return value
    if why := refuse_number(value):
        refused.append((at, why))
        return None
    if at[0] == exact:
        return Decimal(value)
    return float(value) if isinstance(value, Decimal) else value


def _long_number(text: str) -> int:
    """Return the line of the first whole number that is too long to read; 0 if all are short."""
    found = re.search(r"(?<![\w.])[-+]?\d[\d_]{4299,}", text)  # Python reads at most 4,300 digits
    return text.count("\n", 0, found.start()) + 1 if found else 0


def key_lines(text: str) -> Iterator[tuple[int, Location]]:
    """Yield line and path of every heading, and of every key at the beginning of a line."""
    for one in split_statements(text):
        if one.is_heading or (one.at != one.table and "=" in one.lines[0]):
            yield one.line, one.at


def _explain_slip(line: str, message: str, root: type[BaseModel], *, numbers: bool) -> str:
    """Return what is wrong, with ": write …" and the corrected line if it is known.

    Parameters
    ----------
    line, message : the line with the mistake, and what the parser says of it.
    numbers : whether the table of the line takes only numbers.
    """
    line = line[:_LONGEST_LINE]
    key = line.partition("=")[0].strip()
    slips = (s for s in _slips() if re.fullmatch(s.parser, message) or re.search(s.line, line))
    slip = next(slips, _Slip(words=f"not valid TOML: {message}", code="unknown"))
    if slip.code == "unquoted_text" and (numbers or takes_numbers(key, root)):
        return f"{key} takes a number, written in digits"
    words = slip.words
    if numbers and slip.code == "unknown":
        words = f"{key} takes a number, such as 10.1, or a list of numbers"
    new = line
    for pattern, put in slip.mends:
        new = re.sub(pattern, put, new)
    if numbers and "[" not in line:
        new = mend_number(line)
    try:
        read = tomllib.loads(new)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return words
    is_text = numbers and any(isinstance(value, str) for value in read.values())
    mended = new not in ("", line) and new.isprintable() and len(new) <= _SHOWN
    return f"{words}: write {new}" if mended and not is_text else words


@cache
def _slips() -> tuple[_Slip, ...]:
    text = (TEMPLATES / "toml_slips.toml").read_text(encoding="utf-8")
    return tuple(_Slip(**row) for row in tomllib.loads(text)["slips"])


def backslash_words() -> str:
    """Return the sentence about a backslash in quotes."""
    return next(slip.words for slip in _slips() if slip.code == "backslash")


# ------------------------------------------------------------------------------------------ writing


class TypedNumber(str):
    """A number as a person typed it; the file keeps its digits."""


def toml_section(heading: str, entries: Mapping[str, Value]) -> str:
    """Return one table as TOML or, without a heading, the keys for the top of the file."""
    lines = [f"{key} = {toml_value(value)}" for key, value in entries.items()]
    return "\n".join([heading, *lines] if heading else lines) + "\n"


def toml_value(value: Value) -> str:
    """Return a value as TOML in one line."""
    match value:
        case TypedNumber():
            return value
        case str() | bool():
            # JSON's text is valid in TOML too, except that TOML escapes the delete character.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            pairs = (f"{_toml_key(key)} = {toml_value(item)}" for key, item in value.items())
            return f"{{ {', '.join(pairs)} }}"
        case Sequence():
            return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[\w-]+", key, re.ASCII) else toml_value(key)
