"""The class as a table: a line a submission, or a row a submission and criterion."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from math import nan
from typing import TYPE_CHECKING

from pipeline.grading.rubric import Rubric
from pipeline.schemas.grade import CODES, Code, Grade, Outcome

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = (
    "submission", "authors", "status", "days_late", "total", "total_out_of", "remarks",
    "criterion", "outcome", "points", "out_of", "by_hand",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Line:
    """What the pages and tables of a class need of one grade.

    Attributes
    ----------
    name : of the submission as shown, and of its folder of feedback.
    criteria : outcome and points by criterion.
    by_hand : criteria with points given by hand.
    springs : that its recordings ask for and the rubric does not have.
    """

    name: str
    authors: tuple[str, ...]
    status: str
    points: float
    out_of: float
    days_late: float
    deducted: float
    reason: str
    criteria: dict[str, tuple[Outcome, float]]
    codes: tuple[Code, ...]
    by_hand: tuple[str, ...]
    springs: tuple[str, ...] = ()

    @classmethod
    def of(cls, grade: Grade) -> "Line":
        """Return the line of a grade."""
        return cls(
            name=grade.submission,
            authors=grade.authors,
            status=grade.status,
            points=grade.points,
            out_of=grade.out_of,
            days_late=grade.days_late,
            deducted=grade.deducted,
            reason=grade.reason,
            criteria={c.id: (c.outcome, c.points) for c in grade.criteria},
            codes=tuple(dict.fromkeys(flag.code for flag in grade.flags)),
            by_hand=tuple(given.criterion for given in grade.overrides),
            springs=grade.springs,
        )

    @property
    def text(self) -> str:
        """As kept in the gradebook."""
        return json.dumps(asdict(self))

    @classmethod
    def read(cls, text: str, *, shared: bool) -> "Line":
        """Return the line that `text` was of, now that recordings are `shared` or not."""
        plain = json.loads(text)
        codes = {*plain["codes"], *(["shared_data"] if shared else [])}
        lists = {key: tuple(plain[key]) for key in ("authors", "by_hand", "springs")}
        criteria = {id_: tuple(own) for id_, own in plain["criteria"].items()}
        order = tuple(sorted(codes, key=CODES.index)) if codes else ()
        return cls(**{**plain, **lists, "criteria": criteria, "codes": order})


def wrong_springs(graded: Iterable[tuple[str, ...]]) -> str:
    """Return what to ask the instructor where recordings want springs that the rubric has not.

    Parameters
    ----------
    graded : of every submission that was graded, the springs it asks for.
    """
    every = list(graded)
    asking = [springs for springs in every if springs]
    if not asking:
        return ""
    names = ", ".join(dict.fromkeys(name for springs in asking for name in springs))
    return (
        f"the recordings of {len(asking)} of {len(every)} submissions ask for springs that the "
        f"rubric has not ({names}), and were judged with them: is its [system] that of the benches?"
    )


def class_frame(lines: Iterable[Line], *, rubric: Rubric) -> "pd.DataFrame":
    """Return the class, one row a submission and criterion of the rubric.

    Of the submission: `submission`, `authors`, `status`, `days_late`, `total` (the points that
    count, lateness off), `total_out_of`, `remarks` (codes of flags); lists are separated by blanks,
    as in `grades.csv`. Of the criterion: `criterion`, `outcome`, `points`, `out_of`, `by_hand`; one
    that was never judged has no outcome, and NaN points.
    """
    import pandas as pd  # a fifth of a second, and grading a submission needs none of it

    rows = []
    for line in lines:
        whole = (
            line.name,
            " ".join(line.authors),
            line.status,
            line.days_late,
            line.points,
            line.out_of,
            " ".join(line.codes),
        )
        for asked in rubric.criteria:
            outcome, points = line.criteria.get(asked.id, ("", nan))
            by_hand = asked.id in line.by_hand
            rows.append((*whole, asked.id, outcome, points, asked.points, by_hand))
    return pd.DataFrame(rows, columns=[*_COLUMNS])
