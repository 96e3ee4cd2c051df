"""The page of a class: distribution, difficulty, most common mistakes, and all grades."""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from pipeline import __version__
from pipeline.grading.grade import CODES, Code, Grade, class_frame
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.class_questions import Distant, RepeatedAuthors
from pipeline.grading.similarity.shared_flag import Cluster
from pipeline.grading.tolerance import exact
from pipeline.grading.words import WORDS, on_one_line, points_text, signed_points
from pipeline.report.builder import PageBuilder, Part
from pipeline.report.document import (
    Block,
    Cell,
    Details,
    Document,
    Tile,
    Tiles,
    bullet_list,
    cell,
    paragraph,
)
from pipeline.report.figures.grading import difficulty_figure, distribution_figure
from pipeline.report.html import render_html
from pipeline.words.numbers import NOTHING, first_few, listing
from pipeline.words.numbers import count as counted
from pipeline.words.text import Span, Spans, capital, clean, spans

if TYPE_CHECKING:
    import pandas as pd

_OUTCOMES = ("pass", "partial", "fail", "skip")
_HELD = "Held back, so without points here"
_NAMED = 8  # largest number of submissions or recordings in one row


def class_page(
    grades: Sequence[Grade],
    *,
    rubric: Rubric,
    repeated_authors: Sequence[RepeatedAuthors] = (),
    clusters: Sequence[Cluster] = (),
    distant: Sequence[Distant] = (),
    held: Collection[str] = (),
) -> str:
    """Return `class.html`; the same class gives the same bytes.

    Parameters
    ----------
    held : submissions whose grades are held back; only their names are on the page.
    """
    grades = [grade for grade in grades if grade.submission not in held]
    frame = class_frame(grades, rubric=rubric)
    graded = frame.loc[frame["status"] == "graded"]
    points = graded.drop_duplicates("submission").loc[:, "total"]
    parts: list[Part] = [
        (
            "summary",
            "Summary",
            lambda page: [
                *_board(grades, points, rubric),
                *_points(page, points, rubric),
                *_to_look_at(grades, repeated_authors, distant),
                *([paragraph(f"{_HELD}: {listing(sorted(held))}.")] if held else []),
            ],
        ),
        ("mistakes", "Most common mistakes", lambda page: _mistakes(page, grades)),
        ("shared", "Shared recordings and numbers", lambda page: _shared(page, grades, clusters)),
        ("criteria", "Criteria", lambda page: _criteria(page, graded, rubric)),
        ("class", "Everybody", lambda page: _everybody(page, grades)),
    ]
    document = Document(
        title=clean(rubric.title) or "The class",
        subtitle="Class grades",
        authors=(),
        sections=PageBuilder().sections(parts),
        footer=f"cartlab {__version__}",
    )
    return render_html(document)


def _board(grades: Sequence[Grade], points: "pd.Series", rubric: Rubric) -> list[Block]:
    failed = [grade for grade in grades if grade.status == "failed"]
    tiles = [
        Tile(spans("Submissions"), spans(str(len(grades))), url="#class" if grades else ""),
        Tile(
            spans("Could not be graded"),
            spans(str(len(failed))),
            tone="bad" if failed else "good",
        ),
    ]
    if len(points):
        out_of = points_text(rubric.out_of)
        of = WORDS.text("of_those_graded", n=len(points)) if failed else ""
        remarks = sum(grade.status == "graded" and bool(grade.codes) for grade in grades)
        tiles += [
            Tile(spans(f"Mean{of}"), spans(f"{points.mean():.2f} of {out_of}")),
            Tile(spans(f"Median{of}"), spans(f"{points.median():.2f} of {out_of}")),
            Tile(spans("With a flag"), spans(str(remarks)), url="#mistakes"),
        ]
    return [Tiles(tuple(tiles))]


def _to_look_at(
    grades: Sequence[Grade], repeated: Sequence[RepeatedAuthors], distant: Sequence[Distant]
) -> list[Block]:
    """Return what to look at: springs, failures, authors in several teams, unusual carts."""
    failed = [grade for grade in grades if grade.status == "failed"]
    blocks: list[Block] = []
    if asked := wrong_springs(grade.springs for grade in grades if grade.status == "graded"):
        blocks.append(paragraph(capital(asked)))
    if told := not_final(grades):
        blocks.append(paragraph(told))
    if failed:
        reasons = bullet_list(
            spans(_link(grade.submission), f": {clean(on_one_line(grade.reason))}", _by_hand(grade))
            for grade in failed
        )
        if len(failed) > 8:  # fold a long list
            blocks.append(Details(WORDS.spans("many_failed", n=str(len(failed))), (reasons,)))
        else:
            blocks += [paragraph(WORDS.text("some_failed")), reasons]
    if repeated:
        several = bullet_list(spans(f"{people}.") for people in repeated)
        blocks += [paragraph(WORDS.text("doubles")), several]
    if distant:
        others = bullet_list(spans(_link(one.submission), f": {one}.") for one in distant)
        blocks += [paragraph(WORDS.text("distant")), others]
    return blocks


def wrong_springs(graded: Iterable[tuple[str, ...]]) -> str:
    """Return a question for the instructor if recordings need springs missing from the rubric.

    Returns "" if there is nothing to ask.

    Parameters
    ----------
    graded : for each graded submission, the springs missing from the rubric.
    """
    every = list(graded)
    asking = [springs for springs in every if springs]
    if not asking:
        return ""
    names = ", ".join(dict.fromkeys(name for springs in asking for name in springs))
    return (
        f"the recordings of {len(asking)} of {len(every)} submissions need springs that the "
        f"rubric lacks ({names}), and were judged with these springs: does the rubric's [system] "
        "match the benches?"
    )


def not_final(grades: Sequence[Grade]) -> str:
    """Return how many submissions a person has yet to grade, and where; "" if all are final."""
    waiting = Counter(id_ for grade in grades for id_ in grade.open)
    if not waiting:
        return ""
    n = counted(sum(bool(grade.open) for grade in grades), "submission")
    named = listing([f"{id_} ({many})" for id_, many in waiting.items()])
    return WORDS.text("not_final", submissions=n, criteria=named)


def _by_hand(grade: Grade) -> str:
    return f" ({points_text(grade.points)} points by hand)" if grade.by_hand else ""


def _points(page: PageBuilder, points: "pd.Series", rubric: Rubric) -> list[Block]:
    if points.empty:
        return []
    values = {
        "low": points_text(points.min()),
        "high": points_text(points.max()),
        "out_of": points_text(rubric.out_of),
        "submissions": counted(len(points), "submission"),
    }
    figure = distribution_figure(points.to_list(), out_of=rubric.out_of)
    return [page.picture("distribution", figure, WORDS, "distribution", **values)]


def _criteria(page: PageBuilder, graded: "pd.DataFrame", rubric: Rubric) -> list[Block]:
    import pandas as pd

    if graded.empty:
        return []
    ids = [asked.id for asked in rubric.criteria]
    points = graded.pivot(index="submission", columns="criterion", values="points")[ids]
    shares = (points.mean() / [asked.points for asked in rubric.criteria]).to_list()
    outcomes = pd.crosstab(graded["criterion"], graded["outcome"].replace("", "skip"))
    outcomes = outcomes.reindex(index=ids, columns=[*_OUTCOMES], fill_value=0)
    rows = [
        [
            clean(asked.title or asked.id),
            points_text(asked.points),
            NOTHING if math.isnan(share) else f"{100 * share:.0f} %",
            *map(str, outcomes.loc[asked.id]),
        ]
        for asked, share in zip(rubric.criteria, shares, strict=True)
    ]
    judged = [
        (asked.title or asked.id, share)
        for asked, share in zip(rubric.criteria, shares, strict=True)
        if not math.isnan(share)
    ]
    table = page.table(WORDS, "class_criteria", rows, "lrrrrrr")
    if not judged:
        return [table]
    titles, known = zip(*judged, strict=True)
    told = {
        "criteria": str(len(judged)),
        "hardest": titles[int(np.argmin(known))],
        "least": f"{100 * min(known):.0f}",
    }
    figure = difficulty_figure(titles, np.array(known))
    return [page.picture("difficulty", figure, WORDS, "difficulty", **told), table]


def _mistakes(page: PageBuilder, grades: Sequence[Grade]) -> list[Block]:
    """Return the table of flags, the most common first."""
    import pandas as pd

    codes = pd.Series(
        [grade.codes for grade in grades], [grade.submission for grade in grades], dtype=object
    )
    having = codes.explode().dropna()
    if having.empty:
        return [paragraph(WORDS.text("no_remarks"))] if grades else []
    counts = having.value_counts().to_dict()
    order: list[Code] = sorted(counts, key=lambda code: (-counts[code], CODES.index(code)))
    rows = []
    for code in order:
        named = [_link(name) for name in having.loc[having == code].index]
        rows.append(
            [
                spans(f"{WORDS.text(f'title_{code}')} (", Span(code, "code"), ")"),
                str(counts[code]),
                f"{100 * counts[code] / len(grades):.0f} %",
                spans(*_listed(named)),
            ]
        )
    return [page.table(WORDS, "class_remarks", rows, "lrrl")]


def _shared(page: PageBuilder, grades: Sequence[Grade], clusters: Sequence[Cluster]) -> list[Block]:
    """Return the table of what is shared, grouped by clusters of submissions."""
    if not clusters:
        return []
    here = {grade.submission for grade in grades}
    rows = []
    for number, cluster in enumerate(clusters, start=1):
        for submissions, recordings in cluster.by_submissions().items():
            links = [_link(name) if name in here else Span(clean(name)) for name in submissions]
            which = clean(first_few(recordings, _NAMED))
            rows.append([str(number), spans(*_listed(links)), str(len(recordings)), which])
    return [page.table(WORDS, "class_shared", rows, "rlrl")]


def _listed(links: Sequence[Span]) -> list[str | Span]:
    """Return links separated by commas; a long list is cut short and ends with "and 7 more"."""
    text: list[str | Span] = [part for link in links[:_NAMED] for part in (link, ", ")][:-1]
    more = len(links) - _NAMED
    return [*text, f" and {more} more"] if more > 0 else text


def _everybody(page: PageBuilder, grades: Sequence[Grade]) -> list[Block]:
    if not grades:
        return []
    table = page.table(WORDS, "everybody", map(_row, grades), "llrrrll")
    return [replace(table, finder=True)]


def _row(grade: Grade) -> list[Cell | str | Spans]:
    failed = grade.status == "failed"
    share = 100 * exact(grade.points) / exact(grade.out_of) if grade.out_of else 0
    return [
        (_link(grade.submission),),
        clean(listing(grade.authors)) or NOTHING,
        points_text(grade.points),
        f"{math.floor(share)}",  # rounded down, so that only full points give 100
        f"{grade.days_late:.3g}" if grade.days_late else "0",
        cell("not graded yet" if grade.unsettled else "not graded", "bad")
        if failed
        else ", ".join(grade.codes),
        _hand_text(grade),
    ]


def _hand_text(grade: Grade) -> str:
    """Return what a person has changed, and what a person still has to grade."""
    given = [own.criterion for own in grade.overrides]
    given += [f"total {signed_points(one.points)} ({clean(one.why)})" for one in grade.adjustments]
    given += [f"{id_}: open" for id_ in grade.open]
    return ", ".join(given)


def feedback_link(name: str) -> str:
    """Return the address of a submission's feedback, relative to `class.html`."""
    return f"feedback/{quote(name, safe='')}/feedback.html"


def _link(name: str) -> Span:
    return Span(clean(name), url=feedback_link(name))
