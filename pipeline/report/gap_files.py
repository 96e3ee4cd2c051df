"""Files of a gap analysis: make them, read the stored one, save its model for other programs."""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigError, DataError
from pipeline.json_files import json_text
from pipeline.output import write_file
from pipeline.plant.effect import AugmentedChain
from pipeline.report.files import Made, write_files
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.submission.toml import read_text
from pipeline.words.progress import Progress

if TYPE_CHECKING:
    from pipeline.gap.types import Gap

_PLACES = ("gap/gap.json", "gap.json")  # paths in the submission's folder
_MOST_BYTES = 10_000_000  # ten times the size for three carts and a hundred runs

FILES = ("model.fmu", "model.c", "model.h", "model.m")


def with_gap(analysis: Analysis, folder: Path) -> tuple[Analysis, "Gap | None"]:
    """Return the analysis and, if its folder has one, the gap analysis of the same data.

    A gap analysis of other data, or one that cannot be read, becomes a warning.
    """
    gap, warning = _find(folder, analysis)
    if warning:
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
    return analysis, gap


def _find(folder: Path, analysis: Analysis) -> "tuple[Gap | None, str]":
    for place in _PLACES:
        path = folder / place
        if not path.is_file():
            continue
        # Imported late, because it loads the catalogue of effects.
        from pipeline.gap.types import read_gap

        try:
            text = read_text(path, where=place, limit=_MOST_BYTES, error=ConfigError)
            gap = read_gap(text)
            if gap.linear.chain.n != analysis.bench.n:
                raise ConfigError(f"it has {gap.linear.chain.n} carts")
        except ConfigError as error:
            return None, f"{place} cannot be used: {error}"
        if gap.provenance.files != analysis.files:
            return None, f"{place} belongs to other data than this report: run cartlab gap again"
        return gap, ""
    return None, ""


def save_model(
    model: AugmentedChain, analysis: Analysis, out: Path, *, free: Collection[int]
) -> str:
    """Write a model of the `free` carts into the folder `out`; return a sentence on the result.

    A model that would need future inputs is not written; the sentence then says why.
    """
    # Imported late, because it loads the compiled simulator.
    from pipeline.plant.export import Description, c_sources, fmu, matlab_source

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


def make_gap(
    submission: Submission,
    out: Path,
    *,
    make: Callable[..., Made],
    budget: float | None = None,
    pdf: bool = True,
    progress: Progress,
) -> tuple["Gap", Analysis]:
    """Analyse the gap of a submission; write its report and `gap.json`.

    Parameters
    ----------
    make : `make_gap_files`, or a function that calls it in another process.
    budget : time limit of the search, in s.
    """
    from pipeline.workflow import analyse

    analysis = analyse(submission, design=False, progress=progress)
    # These imports load the compiled simulator.
    from pipeline.experiments.discriminate import propose_for
    from pipeline.gap.explain import investigate

    found = investigate(analysis, budget=budget, progress=progress)
    progress("choosing the next recording")
    found = propose_for(found, submission)
    drawn = replace(found, measure_left=tuple)  # which no page shows and no process can send
    made = make(drawn, analysis, pdf=pdf, progress=progress)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "gap.json", json_text(found))
    clear_model(out)
    write_files(made, out, name="gap")
    return found, analysis


def clear_model(out: Path) -> None:
    """Remove an earlier model, because it does not belong to the new gap analysis."""
    for name in FILES:
        (out / name).unlink(missing_ok=True)
