"""The records that models follow, and how work on them is shared out."""

from dataclasses import dataclass, replace

from pipeline.arrays import Array
from pipeline.gap.fit.levenberg_marquardt import Mapper
from pipeline.gap.follow.fit import Follow, Slope, fit_follow, slope_of
from pipeline.gap.follow.laws import COLUMNS, Column, Law, Laws, column_set
from pipeline.gap.follow.track import Track


@dataclass(frozen=True, kw_only=True, eq=False)
class Records:
    """What is followed, how work on it is shared out, and which columns laws may fill."""

    tracks: tuple[Track, ...]
    mapper: Mapper
    columns: frozenset[Column]

    def fit(self, start: Follow, **options) -> Follow:
        """Fit a model from a start, see `fit_follow`."""
        return fit_follow(start, self.tracks, mapper=self.mapper, **options)

    def refit(self, follow: Follow, laws: Laws, p: Array, **options) -> Follow:
        """Fit a model with other laws, the runs' own parameters as they are."""
        return self.fit(replace(follow, laws=laws, p=p), **options)

    def slope(self, follow: Follow, *, factors: bool = True) -> Slope:
        """Return the normal equations, see `slope_of`."""
        return slope_of(follow, self.tracks, factors=factors, mapper=self.mapper)

    def allows(self, law: Law) -> bool:
        """Whether the catalogue has an effect that fills the columns of a law."""
        return column_set(COLUMNS[law.kind]) <= self.columns
