"""Types as JSON files: a file holds what its type marks as written, in the order of the type.

A result type marks its fields by `written`, and what it derives by `computed`. From the marks
come the file (`json_text`), its JSON Schema (`json_schema`) and reading it back (`read_json`).
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
_SIGNIFICANT = 10  # digits: below that, processors and library versions differ


# --------------------------------------------------------------------- marking a type


class InFile(NamedTuple):
    """The form in the file of a value of the annotated type."""

    type: Any


Number = Annotated[float, InFile(float | None)]  # null where it is not finite
Numbers = Annotated[Array, InFile(tuple[float | None, ...])]  # each of them, likewise
Sha256 = Annotated[str, InFile(Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")])]
Matrix = Annotated[Array, InFile(tuple[tuple[float, ...], ...])]


class _Mark(NamedTuple):
    """How a member is written; its `order` among the others is that of the class body."""

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
    description : for the JSON Schema.
    key : in the file, by default the field's name.
    part : the keys that are written of the type it holds, in their order; by default all.
    older : what a file without the key stands for, where earlier versions wrote none.
    default, default_factory : of the field.
    """
    mark = _Mark(next(_ORDER), description, key, part, older)
    return field(default=default, default_factory=default_factory, metadata={"written": mark})


def computed(
    *, key: str = "", part: tuple[str, ...] = (), older: Any = MISSING
) -> Callable[[F], F]:
    """Mark the function of a property that is written to the file; its docstring describes it."""

    def mark(function: F) -> F:
        description = (getdoc(function) or "").removesuffix(".")
        vars(function)["written"] = _Mark(next(_ORDER), description, key, part, older)
        return function

    return mark


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(written, field))
def result(*, eq: bool = True) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass; `eq` as there: False where it holds arrays."""
    return dataclass(frozen=True, kw_only=True, eq=eq)


@dataclass(frozen=True, kw_only=True)
class WrittenMember:
    """The content that a type writes under one key; `stored` if it is a field, not derived."""

    name: str
    key: str
    hint: Any
    description: str
    part: tuple[str, ...]
    older: Any
    stored: bool


@cache
def members(cls: type, part: tuple[str, ...] = ()) -> tuple[WrittenMember, ...]:
    """Return what a type writes, in the order of the file; with `part` those keys alone."""
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
    """Return the keys of a type in its file."""
    return [member.key for member in members(cls)]


# --------------------------------------------------------------------------- writing


def json_text(value: Any) -> str:
    """Return a file as text: same numbers, same bytes."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain(value: Any, *, digits: int = _SIGNIFICANT, part: tuple[str, ...] = ()) -> Any:
    """Return JSON's own types: floats at so many digits, NaN and infinity as None.

    Of a result what it writes, with `part` those keys alone; of a model its fields.
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
        case _ if hasattr(value, "written_as"):  # the name of what stands for it
            return getattr(value, value.written_as)
        case _ if is_dataclass(value):
            return {
                own.key: plain(getattr(value, own.name), digits=digits, part=own.part)
                for own in members(type(value), part)
            }
        case _ if math.isfinite(value):
            return float(f"{value:.{digits}g}") + 0.0  # no minus zero
        case _:
            return None


# ------------------------------------------------------------------------ the schema


def json_schema(cls: type, *, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a type's files, its definitions in alphabetical order."""
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
    """Return what checks a file of a type; unknown keys are let through, as later ones may come.

    Its fields have the keys as aliases, and the names of the members with a `_` behind.
    """
    if issubclass(cls, BaseModel):
        return cls
    # Only the first paragraph concerns the written fields.
    about = (getdoc(cls) or "").partition("\n\nAttributes\n")[0]
    found: dict[str, Any] = {
        f"{own.name}_": (
            _file_type(own.hint, own.part),
            Field(
                default=... if own.older is MISSING else own.older,
                alias=own.key,
                description=own.description or None,
            ),
        )
        for own in members(cls, part)
    }
    name = cls.__name__ + ("Part" if part else "")
    settings = ConfigDict(frozen=True, allow_inf_nan=False)
    return create_model(name, __config__=settings, __doc__=about, **found)


def _file_type(hint: Any, part: tuple[str, ...]) -> Any:
    """Return the type in the file for a value of a type."""
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
    """Return the value that a file of a type holds; fields that are not written have defaults.

    `readers` make a value of the name that stands for it. A type whose values are not made of
    their fields as written has a class method `from_written`, which takes all its members.

    Raises
    ------
    ValueError : it is no such file (pydantic's `ValidationError`), or null where a number is
        needed.
    """
    return _build(cls, file_model(cls).model_validate_json(text), readers or {})


def _build(hint: Any, value: Any, readers: Readers) -> Any:
    """Return the value of a type that what a file holds stands for."""
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
