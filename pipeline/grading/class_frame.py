"""The grades of a class as a table, with one row per submission and criterion."""

from collections.abc import Iterable
from math import nan
from typing import TYPE_CHECKING

from pipeline.grading.grade import Grade
from pipeline.grading.rubric import Rubric

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = (
    "submission", "authors", "status", "days_late", "total", "total_out_of", "remarks",
    "criterion", "outcome", "points", "out_of", "by_hand",
)  # fmt: skip


def class_frame(grades: Iterable[Grade], *, rubric: Rubric) -> "pd.DataFrame":
    """Return the class as a table with one row per submission and criterion.

    Columns about the submission: `submission`, `authors`, `status`, `days_late`, `total` (after the
    deduction for lateness), `total_out_of`, `remarks` (codes of flags). Spaces separate the items
    of a list, as in `grades.csv`.

    Columns about the criterion: `criterion`, `outcome`, `points`, `out_of`, `by_hand`. A criterion
    that was never judged has an empty outcome, and its points are NaN.
    """
    import pandas as pd  # imported late: it takes 0.2 s, and grading does not need it

    rows = []
    for grade in grades:
        whole = (
            grade.submission,
            " ".join(grade.authors),
            grade.status,
            grade.days_late,
            grade.points,
            grade.out_of,
            " ".join(grade.codes),
        )
        judged, by_hand = grade.judged, grade.by_hand
        for asked in rubric.criteria:
            own = judged.get(asked.id)
            came_to = (own.outcome, own.points) if own else ("", nan)
            rows.append((*whole, asked.id, *came_to, asked.points, asked.id in by_hand))
    return pd.DataFrame(rows, columns=[*_COLUMNS])
