"""What all JSON files share: their smaller tables, how they are filled in, and how written."""

import json
import math
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

_DIGITS = 10  # significant: below that, processors and library versions differ

DIALECT = "https://json-schema.org/draft/2020-12/schema"

Number = float | None  # null: could not be had
Numbers = tuple[float, ...]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Document(BaseModel):
    """A table of a JSON file; unknown keys are let through, as later versions may add some."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Units(Document):
    """The submission's own units."""

    position: str
    input: str


class ChainUnits(Document):
    """Units of masses, dampings and stiffnesses."""

    m: str
    c: str
    k: str


class Chain(Document):
    """Carts and springs; the input gain is one, so all are in input units."""

    m: Annotated[Numbers, Field(description="masses, cart 1 first")]
    c: Annotated[Numbers, Field(description="dampings, cart 1 first")]
    k: Annotated[
        Numbers,
        Field(description="springs wall-1, 1-2, …, n-wall; one cart: their sum, then 0"),
    ]


class ChainWithUnits(Chain):
    """Carts and springs with their units."""

    units: ChainUnits


class Margins(Document):
    """How much the designed loop, cut at the motor, may change before it is unstable."""

    gain: Annotated[Number, Field(description="a factor; null where none makes it unstable")]
    phase_deg: Annotated[Number, Field(description="of lag; of lead where below zero")]
    modulus: Annotated[Number, Field(description="least distance of the Nyquist curve from -1")]
    omega_gain: Annotated[Number, Field(description="rad/s")]
    omega_phase: Annotated[Number, Field(description="rad/s")]


class Provenance(Document):
    """What made the file, and of what."""

    version: Annotated[str, Field(description="of cartlab")]
    files: Annotated[dict[str, Sha256], Field(description="SHA-256 of every data file")]


def json_schema(model: type[Document], *, title: str) -> dict[str, Any]:
    """Return the JSON Schema of a model's files, its definitions in alphabetical order."""
    schema = model.model_json_schema(by_alias=True, mode="serialization")
    definitions = schema.pop("$defs", {})
    return {
        "$schema": DIALECT,
        **schema,
        "title": title,
        "$defs": dict(sorted(definitions.items())),
    }


def fields_of(model: type[Document], source: object, **made: Any) -> dict[str, Any]:
    """Return what a table of a file holds: each field as made, else the attribute of its name."""
    return {
        own.alias or name: made[name] if name in made else getattr(source, name)
        for name, own in model.model_fields.items()
    }


def json_text(document: Any) -> str:
    """Return a file as text: same numbers, same bytes."""
    return json.dumps(plain_json(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def plain_json(value: Any) -> Any:
    """Return JSON's own types, floats at `_DIGITS` significant digits, NaN and infinity as None."""
    match value:
        case dict():
            return {key: plain_json(item) for key, item in value.items()}
        case list() | tuple():
            return [plain_json(item) for item in value]
        case np.ndarray():
            return plain_json(value.tolist())
        case bool() | None | str() | int():
            return value
        case np.bool_():
            return bool(value)
        case np.integer():
            return int(value)
        case _ if math.isfinite(value):
            return float(f"{value:.{_DIGITS}g}") + 0.0  # no minus zero
        case _:
            return None
