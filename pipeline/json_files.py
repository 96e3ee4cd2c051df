"""Write types to JSON files and read them back.

A result type marks its fields with `written` and derived values with `computed`. The functions
`json_text`, `json_schema` and `read_json` follow these marks. The keys have the order of the class
body.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from inspect import getdoc
from itertools import count
from types import GenericAlias, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    NamedTuple,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model

from pipeline.arrays import Array, ComplexArray

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
_ORDER = count()
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SIGNIFICANT = 10  # significant digits; further ones depend on processor and library versions


# --------------------------------------------------------------------- marking a type


class InFile(NamedTuple):
    """An annotation with the type that a value has in the file."""

    type: Any


Number = Annotated[float, InFile(float | None)]  # null if it is not finite
Numbers = Annotated[Array, InFile(tuple[float | None, ...])]  # each null if not finite
Sha256 = Annotated[str, InFile(Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")])]
Matrix = Annotated[Array, InFile(tuple[tuple[float, ...], ...])]


class _Mark(NamedTuple):
    """How a member is written to the file; `order` is its position in the class body."""

    order: int
    description: str
    key: str
    part: tuple[str, ...]
    older: Any


def written(
    description: str = "",
    *,
    key: str = "",
    part: tuple[str, ...] = (),
    older: Any = MISSING,
    default: Any = MISSING,
    default_factory: Any = MISSING,
) -> Any:
    """Return a field of a `result` that is written to its file.

    Parameters
    ----------
    description : text for the JSON Schema.
    key : the key in the file. By default the field's name.
    part : the keys to write if the field holds a `result`, in this order; all by default.
    older : the value to assume for a file of an earlier version, which lacks the key.
    default, default_factory : as for a dataclass field.
    """
    mark = _Mark(next(_ORDER), description, key, part, older)
    return field(default=default, default_factory=default_factory, metadata={"written": mark})


def computed(
    *, key: str = "", part: tuple[str, ...] = (), older: Any = MISSING
) -> Callable[[F], F]:
    """Mark a property as written to the file; its docstring is the description."""

    def mark(function: F) -> F:
        description = (getdoc(function) or "").removesuffix(".")
        vars(function)["written"] = _Mark(next(_ORDER), description, key, part, older)
        return function

    return mark


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(written, field))
def result(*, eq: bool = True) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass; pass `eq=False` if it holds arrays."""
    return dataclass(frozen=True, kw_only=True, eq=eq)


@dataclass(frozen=True, kw_only=True)
class WrittenMember:
    """One member that is written to a type's file; `stored` is false for a property."""

    name: str
    key: str
    hint: Any
    description: str
    part: tuple[str, ...]
    older: Any
    stored: bool


@cache
def members(cls: type, part: tuple[str, ...] = ()) -> tuple[WrittenMember, ...]:
    """Return the written members of a type in file order; `part` selects some by their keys."""
    hints = get_type_hints(cls, include_extras=True)
    marks = {
        own.name: (own.metadata["written"], hints[own.name])
        for own in fields(cls)
        if "written" in own.metadata
    }
    stored = set(marks)
    for base in cls.__mro__:
        for name, value in vars(base).items():
            function = getattr(value, "fget", None)
            mark = getattr(function, "written", None)
            if function and mark:
                marks[name] = (mark, get_type_hints(function, include_extras=True)["return"])
    found = {
        mark.key or name: WrittenMember(
            name=name,
            key=mark.key or name,
            hint=hint,
            description=mark.description,
            part=mark.part,
            older=mark.older,
            stored=name in stored,
        )
        for name, (mark, hint) in sorted(marks.items(), key=lambda item: item[1][0].order)
    }
    return tuple(found[key] for key in part or found)


def keys(cls: type) -> list[str]:
    """Return the keys that a type writes to its file."""
    return [member.key for member in members(cls)]


# --------------------------------------------------------------------------- writing


def json_text(value: Any) -> str:
    """Return the JSON text of a value; the same numbers always give the same bytes."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain(value: Any, *, digits: int = _SIGNIFICANT, part: tuple[str, ...] = ()) -> Any:
    """Return a value as plain JSON types: floats rounded to `digits`, NaN and infinity as None.

    A `result` becomes a dict of its written members, or only of the keys in `part`. A pydantic
    model becomes a dict of its fields.
    """
    match value:
        case None | bool() | str() | int():
            return value
        case dict():
            return {key: plain(item, digits=digits, part=part) for key, item in value.items()}
        case list() | tuple():
            return [plain(item, digits=digits, part=part) for item in value]
        case np.ndarray():
            return plain(value.tolist(), digits=digits)
        case np.bool_() | np.integer():
            return value.item()
        case complex():
            return plain([value.real, value.imag], digits=digits)
        case BaseModel():
            return plain(value.model_dump(by_alias=True), digits=digits)
        case _ if hasattr(value, "written_as"):  # written as the name of the object
            return getattr(value, value.written_as)
        case _ if is_dataclass(value):
            return {
                own.key: plain(getattr(value, own.name), digits=digits, part=own.part)
                for own in members(type(value), part)
            }
        case _ if math.isfinite(value):
            return float(f"{value:.{digits}g}") + 0.0  # + 0.0 turns -0.0 into 0.0
        case _:
            return None


# ------------------------------------------------------------------------ the schema


def json_schema(cls: type, *, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a type's files, with its definitions in alphabetical order."""
    schema = file_model(cls).model_json_schema(by_alias=True, mode="serialization")
    definitions = schema.pop("$defs", {})
    return {
        "$schema": DIALECT,
        **schema,
        "title": title,
        "$defs": dict(sorted(definitions.items())),
    }


@cache
def file_model(cls: type, part: tuple[str, ...] = ()) -> type[BaseModel]:
    """Return the pydantic model that checks a type's file.

    Unknown keys are allowed, because later versions may add some. The model's fields are named
    after the members with `_` appended; their aliases are the keys.
    """
    if issubclass(cls, BaseModel):
        return cls
    # Only the docstring's text before `Attributes` describes the written fields.
    about = (getdoc(cls) or "").partition("\n\nAttributes\n")[0]
    found: dict[str, Any] = {
        f"{own.name}_": (
            _file_type(own.hint, own.part),
            Field(
                default=... if own.older is MISSING else _as_written(own.older),
                alias=own.key,
                description=own.description or None,
            ),
        )
        for own in members(cls, part)
    }
    name = cls.__name__ + ("Part" if part else "")
    settings = ConfigDict(frozen=True, allow_inf_nan=False)
    return create_model(name, __config__=settings, __doc__=about, **found)


def _as_written(value: Any) -> Any:
    """Return a value as the file's model holds it."""
    if is_dataclass(value) and not isinstance(value, type):
        return file_model(type(value)).model_validate(plain(value))
    return value


def _file_type(hint: Any, part: tuple[str, ...]) -> Any:
    """Return the type that a value of type `hint` has in the file."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return args[1].type
    if hint == Array:
        return tuple[float, ...]
    if hint == ComplexArray:
        return tuple[tuple[float | None, float | None], ...]
    if origin in (Union, UnionType):
        return Union[tuple(_file_type(one, part) for one in args)]  # noqa: UP007
    if origin in (tuple, dict):
        inner = tuple(one if one is ... else _file_type(one, part) for one in args)
        return GenericAlias(origin, inner)
    if isinstance(hint, type) and hasattr(hint, "written_as"):
        return str
    if isinstance(hint, type) and is_dataclass(hint):
        return file_model(hint, part)
    return hint


# ---------------------------------------------------------------------- reading back

Readers = Mapping[type, Callable[[str], Any]]


def read_json(cls: type[T], text: str | bytes, *, readers: Readers | None = None) -> T:
    """Return the value that a file of type `cls` holds; unwritten fields get their defaults.

    `readers` maps each type that is written as a name to the function that finds the object by
    name. A type whose fields differ from its written members needs a class method `from_written`,
    which takes all written members.

    Raises
    ------
    ValueError : the file does not fit the type (pydantic's `ValidationError`), or it holds null
        where a number is needed.
    """
    return _build(cls, file_model(cls).model_validate_json(text), readers or {})


def _build(hint: Any, value: Any, readers: Readers) -> Any:
    """Return the value of type `hint` for the checked content of a file."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _build(args[0], value, readers)
    if origin in (Union, UnionType):
        (one, *others) = [one for one in args if one is not NoneType]
        return value if value is None or others else _build(one, value, readers)
    if value is None:
        raise ValueError("null where a number is needed")
    if hint == Array:
        return np.array(value, dtype=np.float64)
    if origin is tuple:
        return tuple(_build(args[0], one, readers) for one in value)
    if origin is dict:
        return {key: _build(args[1], one, readers) for key, one in value.items()}
    if isinstance(value, BaseModel):
        make = getattr(hint, "from_written", None)
        own = {
            one.name: _build(one.hint, getattr(value, f"{one.name}_"), readers)
            for one in members(hint)
            if make or one.stored
        }
        return (make or hint)(**own)
    return readers[hint](value) if hint in readers else value
