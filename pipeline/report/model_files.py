"""Save a model for other programs: `model.fmu`, `model.c` with its header, and `model.m`."""

from collections.abc import Collection
from pathlib import Path

from pipeline.errors import DataError
from pipeline.output import write_file
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.export import Description, c_sources, fmu, matlab_source
from pipeline.results import Analysis

FILES = ("model.fmu", "model.c", "model.h", "model.m")


def save_model(
    model: AugmentedChain, analysis: Analysis, out: Path, *, free: Collection[int]
) -> str:
    """Write a model of the `free` carts into the folder `out`; return a sentence on the result.

    A model that would need future inputs is not written; the sentence then says why.
    """
    driven = [record.input_scale for record in analysis.records if record.u is not None]
    sign_reversed = sum(scale > 0 for scale in driven) < sum(scale < 0 for scale in driven)
    try:
        description = Description(
            model, units=analysis.bench.units, free=free, sign_reversed=sign_reversed
        )
    except DataError as error:
        return f"no model was written: {error}"
    whole, compiled = fmu(description)
    write_file(out / "model.fmu", whole)
    for name, text in c_sources(description).items():
        write_file(out / name, text)
    write_file(out / "model.m", matlab_source(description))
    alone = "" if compiled else "; without a C compiler, model.fmu has C sources but no binary"
    return f"wrote {out / 'model.fmu'}, model.c, model.h and model.m{alone}"


def clear_model(out: Path) -> None:
    """Remove an earlier model, because it does not belong to the new gap analysis."""
    for name in FILES:
        (out / name).unlink(missing_ok=True)
