"""Read the gap analysis that is stored next to the data of a report."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigError
from pipeline.results import Analysis
from pipeline.submission.toml import read_text

if TYPE_CHECKING:
    from pipeline.gap.types import Gap

_PLACES = ("gap/gap.json", "gap.json")  # paths in the submission's folder
_MOST_BYTES = 10_000_000  # ten times the size for three carts and a hundred runs


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
