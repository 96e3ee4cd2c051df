"""Write types to JSON files and read them back.

A result type marks its fields with `written` and derived values with `computed`. The keys have the
order of the class body. Pydantic checks a file, builds its values and describes it in a JSON
Schema.
"""

import json
import math
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from dataclasses import Field as StoredField
from functools import cache
from inspect import getdoc, getmembers_static
from typing import Annotated, Any, NamedTuple, TypeVar, cast, dataclass_transform, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, TypeAdapter, create_model
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, core_schema

from pipeline.arrays import Array, ComplexArray

T = TypeVar("T")
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SIGNIFICANT = 10  # significant digits; further ones depend on processor and library versions


# ------------------------------------------------------------------ types in the file


class InFile(NamedTuple):
    """An annotation: the type that a value has in the file, and how to read it from there."""

    type: Any
    read: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            self.read, handler.generate_schema(self.type), serialization=_AS_WRITTEN
        )


def _array(values: Any) -> Array:
    return np.array(values, dtype=np.float64)


def _complex(pairs: Any) -> ComplexArray:
    return _array(pairs).reshape(-1, 2).view(np.complex128)[:, 0]


Number = Annotated[float, InFile(float | None, lambda x: math.nan if x is None else x)]
Numbers = Annotated[Array, InFile(tuple[float | None, ...], _array)]  # null if not finite
FiniteNumbers = Annotated[Array, InFile(tuple[float, ...], _array)]
Matrix = Annotated[Array, InFile(tuple[tuple[float, ...], ...], _array)]
Poles = Annotated[ComplexArray, InFile(tuple[tuple[float | None, float | None], ...], _complex)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


# --------------------------------------------------------------------- marking a type


def written(
    description: str = "", *, key: str = "", default: Any = MISSING, default_factory: Any = MISSING
) -> Any:
    """Return a field of a `result` that is written to its file.

    Parameters
    ----------
    description : text for the JSON Schema.
    key : the key in the file. By default the field's name.
    default : as for a dataclass field; also for a file of an earlier version, without the key.
    default_factory : as for a dataclass field; the file must have the key.
    """
    mark = _mark(description, key=key, default=default)
    return field(default=default, default_factory=default_factory, metadata={"written": mark})


def computed(*, key: str = "", default: Any = MISSING) -> type[property]:
    """Make a method a property that is written to the file; its docstring is the description."""

    def mark(function: Callable[[Any], Any]) -> property:
        description = (getdoc(function) or "").removesuffix(".")
        vars(function)["written"] = _mark(description, key=key, default=default)
        return property(function)

    return cast(type[property], mark)  # type checkers treat it as `@property`


def _mark(description: str, *, key: str, default: Any) -> FieldInfo:
    """Return how pydantic checks and describes a member."""
    value = ... if default is MISSING else plain(default)
    return Field(value, alias=key or None, description=description or None, validate_default=True)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(written, field))
def result(*, eq: bool = True) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass with a file; pass `eq=False` if it holds arrays.

    A type whose fields differ from its written members needs a class method `from_written`, which
    takes all written members.
    """

    def make(cls: type[T]) -> type[T]:
        marks = dict(_marks(cls))
        for name, value in vars(cls).items():
            if isinstance(value, StoredField):
                mark = value.metadata.get("written")
            else:
                mark = getattr(getattr(value, "fget", None), "written", None)
            if mark is not None:
                marks[name] = mark
        added = {"__written__": marks, "__get_pydantic_core_schema__": classmethod(_result_schema)}
        for name, value in added.items():
            setattr(cls, name, value)
        return dataclass(frozen=True, kw_only=True, eq=eq)(cls)

    return make


def _marks(cls: type) -> dict[str, FieldInfo]:
    """Return the marks of a type's written members by name, in file order."""
    return getattr(cls, "__written__", {})


def keys(cls: type) -> list[str]:
    """Return the keys that a type writes to its file."""
    return [mark.alias or name for name, mark in _marks(cls).items()]


# --------------------------------------------------------------------------- writing


def json_text(value: Any) -> str:
    """Return the JSON text of a value; the same numbers always give the same bytes."""
    return json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain(value: Any, *, digits: int = _SIGNIFICANT) -> Any:
    """Return a value as plain JSON types: floats rounded to `digits`, NaN and infinity as None.

    A `result` becomes a dict of its written members, a pydantic model a dict of its fields.
    """
    match value:
        case None | bool() | str() | int():
            return value
        case dict():
            return {key: plain(item, digits=digits) for key, item in value.items()}
        case list() | tuple():
            return [plain(item, digits=digits) for item in value]
        case np.ndarray() | np.bool_() | np.integer():
            return plain(value.tolist(), digits=digits)
        case complex():
            return plain([value.real, value.imag], digits=digits)
        case BaseModel():
            return plain(value.model_dump(by_alias=True), digits=digits)
        case _ if hasattr(value, "written_as"):  # written as the name of the object
            return getattr(value, value.written_as)
        case _ if is_dataclass(value):
            marks = _marks(type(value)).items()
            return {m.alias or own: plain(getattr(value, own), digits=digits) for own, m in marks}
        case _ if math.isfinite(value):
            return float(f"{value:.{digits}g}") + 0.0  # + 0.0 turns -0.0 into 0.0
        case _:
            return None


_AS_WRITTEN = core_schema.plain_serializer_function_ser_schema(plain)


# --------------------------------------------------------------- reading and the schema


def read_json(cls: type[T], text: str | bytes) -> T:
    """Return the value that a file of type `cls` holds; unwritten fields get their defaults.

    Raises
    ------
    ValueError : the file does not fit the type (pydantic's `ValidationError`).
    """
    return TypeAdapter(cls).validate_json(text)


def json_schema(cls: type, *, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a type's files, with its definitions in alphabetical order."""
    schema = file_model(cls).model_json_schema(by_alias=True, mode="serialization")
    definitions = dict(sorted(schema.pop("$defs", {}).items()))
    return {"$schema": DIALECT, **schema, "title": title, "$defs": definitions}


@cache
def file_model(cls: type) -> type[BaseModel]:
    """Return the pydantic model that checks a type's file.

    Unknown keys are allowed, because later versions may add some. The model's fields are named
    after the members with `_` appended; their aliases are the keys.
    """
    if issubclass(cls, BaseModel):
        return cls
    hints = get_type_hints(cls, include_extras=True)
    for name, own in getmembers_static(cls, lambda own: isinstance(own, property)):
        hints[name] = get_type_hints(own.fget, include_extras=True).get("return")
    found: dict[str, Any] = {f"{name}_": (hints[name], m) for name, m in _marks(cls).items()}
    # Only the docstring's text before `Attributes` describes the written fields.
    about = (getdoc(cls) or "").partition("\n\nAttributes\n")[0]
    settings = ConfigDict(
        frozen=True, allow_inf_nan=False, alias_generator=lambda name: name.removesuffix("_")
    )
    return create_model(cls.__name__, __config__=settings, __doc__=about, **found)


def _result_schema(cls: type, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
    """Return how pydantic checks, builds and writes a `result`."""
    own = fields(cls)  # pyright: ignore[reportArgumentType]
    make = getattr(cls, "from_written", None)
    needed = {one.name for one in own if one.default is one.default_factory is MISSING}
    names = [name for name in _marks(cls) if make or name in {one.name for one in own}]

    def read(value: Any, check: core_schema.ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, cls):
            return value
        model = check(value)
        if not make and not needed <= set(names):
            return model  # the file has not all that the type needs
        return (make or cls)(**{name: getattr(model, f"{name}_") for name in names})

    return core_schema.no_info_wrap_validator_function(
        read, handler.generate_schema(file_model(cls)), serialization=_AS_WRITTEN
    )
