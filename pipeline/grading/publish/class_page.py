"""The class at a glance: distribution, difficulty, the most common mistakes, everybody's grade."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from pipeline import __version__
from pipeline.grading.gradebook.class_lines import Line, class_frame, wrong_springs
from pipeline.grading.references.tolerance import exact
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.clusters import Cluster
from pipeline.grading.similarity.doubles import Double
from pipeline.grading.words import WORDS, on_one_line, points_text
from pipeline.names import first_few
from pipeline.report.document import (
    Block,
    Cell,
    Details,
    Document,
    Picture,
    Section,
    Span,
    Tile,
    Tiles,
    bullet_list,
    cell,
    make_table,
    paragraph,
    spans,
)
from pipeline.report.figures.grading import difficulty_figure, distribution_figure
from pipeline.report.figures.style import WIDTH, drawing
from pipeline.report.figures.svg import to_svg
from pipeline.report.numbers import NOTHING, listing
from pipeline.report.numbers import count as counted
from pipeline.report.render.html import render_html
from pipeline.report.words import capital, clean
from pipeline.schemas.grade import CODES, Code

if TYPE_CHECKING:
    import pandas as pd

_OUTCOMES = ("pass", "partial", "fail", "skip")
_NAMED = 8  # submissions named beside a mistake
_MOST_FAILED = 8  # whose reasons the summary shows unasked


def class_page(
    lines: Sequence[Line],
    *,
    rubric: Rubric,
    doubles: Sequence[Double] = (),
    clusters: Sequence[Cluster] = (),
) -> str:
    """Return `class.html`; same class, same bytes."""
    frame = class_frame(lines, rubric=rubric)
    graded = frame.loc[frame["status"] == "graded"]
    points = graded.drop_duplicates("submission").loc[:, "total"]
    tables, pictures = count(1), count(1)
    with drawing():
        parts = [
            ("summary", "Summary", _summary(lines, points, rubric, doubles)),
            ("points", "Points", _points(points, rubric, pictures)),
            ("criteria", "Criteria", _criteria(graded, rubric, tables, pictures)),
            ("mistakes", "Most common mistakes", _mistakes(lines, tables)),
            ("shared", "Shared recordings", _shared(lines, clusters, tables)),
            ("class", "Everybody", _everybody(lines, tables)),
        ]
    document = Document(
        title=clean(rubric.title) or "The class",
        subtitle="Class grades",
        authors=(),
        sections=tuple(
            Section(id_, title, tuple(blocks)) for id_, title, blocks in parts if blocks
        ),
        footer=f"cartlab {__version__}",
    )
    return render_html(document)


def _summary(
    lines: Sequence[Line], points: "pd.Series", rubric: Rubric, doubles: Sequence[Double]
) -> list[Block]:
    failed = [line for line in lines if line.status == "failed"]
    tiles = [
        Tile(spans("Submissions"), spans(str(len(lines))), url="#class" if lines else ""),
        Tile(
            spans("Could not be graded"),
            spans(str(len(failed))),
            tone="bad" if failed else "good",
        ),
    ]
    if len(points):
        out_of = points_text(rubric.out_of)
        of = f" of the {len(points)} graded" if failed else ""
        remarks = sum(line.status == "graded" and bool(line.codes) for line in lines)
        tiles += [
            Tile(spans(f"Mean{of}"), spans(f"{points.mean():.2f} of {out_of}"), url="#points"),
            Tile(spans(f"Median{of}"), spans(f"{points.median():.2f} of {out_of}"), url="#points"),
            Tile(spans("With a remark"), spans(str(remarks)), url="#mistakes"),
        ]
    blocks: list[Block] = [Tiles(tuple(tiles))]
    if asked := wrong_springs(line.springs for line in lines if line.status == "graded"):
        blocks.append(paragraph(capital(asked)))
    if failed:
        said = "could not be graded; points can be given by hand"
        reasons = bullet_list(
            spans(_link(line.name), f": {clean(on_one_line(line.reason))}", _hand(line))
            for line in failed
        )
        if len(failed) > _MOST_FAILED:
            blocks.append(Details(spans(f"{len(failed)} {said}"), (reasons,)))
        else:
            blocks += [paragraph(f"These {said}:"), reasons]
    if doubles:
        said = "Nobody is accused for what submissions with an author in common share. To look at:"
        blocks += [paragraph(said), bullet_list(spans(f"{double}.") for double in doubles)]
    return blocks


def _hand(line: Line) -> str:
    return f" ({points_text(line.points)} points by hand)" if line.by_hand else ""


def _points(points: "pd.Series", rubric: Rubric, pictures: count) -> list[Block]:
    if points.empty:
        return []
    low, high = points_text(points.min()), points_text(points.max())
    alt = (
        f"Histogram of the points of {counted(len(points), 'submission')}, from {low} to {high} "
        f"of {points_text(rubric.out_of)}."
    )
    caption = f"How many of those graded have how many points; they go from {low} to {high}."
    figure = distribution_figure(points.to_list(), out_of=rubric.out_of)
    return [_picture(pictures, "distribution", to_svg(figure, name="distribution", alt=alt),
                     caption=caption, alt=alt)]  # fmt: skip


def _criteria(
    graded: "pd.DataFrame", rubric: Rubric, tables: count, pictures: count
) -> list[Block]:
    import pandas as pd

    if graded.empty:
        return []
    ids = [asked.id for asked in rubric.criteria]
    points = graded.pivot(index="submission", columns="criterion", values="points")[ids]
    shares = (points.mean() / [asked.points for asked in rubric.criteria]).fillna(0.0).to_list()
    outcomes = pd.crosstab(graded["criterion"], graded["outcome"])
    outcomes = outcomes.reindex(index=ids, columns=[*_OUTCOMES], fill_value=0)
    rows = [
        [
            cell(clean(asked.title or asked.id)),
            cell(points_text(asked.points)),
            cell(f"{100 * share:.0f} %"),
            *(cell(str(n)) for n in outcomes.loc[asked.id]),
        ]
        for asked, share in zip(rubric.criteria, shares, strict=True)
    ]
    hardest = rubric.criteria[int(np.argmin(shares))]
    alt = (
        f"Bars with the mean share of the points that each of {len(shares)} criteria earned; "
        f"least: {hardest.title or hardest.id}, {100 * min(shares):.0f} %."
    )
    figure = difficulty_figure([c.id for c in rubric.criteria], np.array(shares))
    return [
        _picture(
            pictures,
            "difficulty",
            to_svg(figure, name="difficulty", alt=alt),
            caption="The mean share of the points that each criterion earned in those graded.",
            alt=alt,
        ),
        make_table(
            next(tables),
            "How the criteria came out: submissions by outcome.",
            ("Criterion", "Points", "Mean", "Passed", "In part", "Not passed", "Not checked"),
            rows,
            "lrrrrrr",
        ),
    ]


def _mistakes(lines: Sequence[Line], tables: count) -> list[Block]:
    """Return the flags, the most common first."""
    import pandas as pd

    codes = pd.Series([line.codes for line in lines], [line.name for line in lines], dtype=object)
    having = codes.explode().dropna()
    if having.empty:
        return [paragraph("No submission has a remark.")] if lines else []
    counts = having.value_counts().to_dict()
    order: list[Code] = sorted(counts, key=lambda code: (-counts[code], CODES.index(code)))
    rows = []
    for code in order:
        named = [_link(name) for name in having.loc[having == code].index]
        rows.append(
            [
                cell(spans(f"{WORDS.text(f'title_{code}')} (", Span(code, "code"), ")")),
                cell(str(counts[code])),
                cell(f"{100 * counts[code] / len(lines):.0f} %"),
                cell(spans(*_listed(named))),
            ]
        )
    head = ("Remark", "Submissions", "Share", "Whose")
    return [
        make_table(next(tables), "The remarks made, the most common first.", head, rows, "lrrl")
    ]


def _shared(lines: Sequence[Line], clusters: Sequence[Cluster], tables: count) -> list[Block]:
    """Return who shares recordings with whom, a cluster after the other."""
    if not clusters:
        return []
    here = {line.name for line in lines}
    rows = []
    for number, cluster in enumerate(clusters, start=1):
        for submissions, recordings in cluster.by_submissions().items():
            links = [_link(name) if name in here else Span(clean(name)) for name in submissions]
            rows.append(
                [
                    cell(str(number)),
                    cell(spans(*_listed(links))),
                    cell(str(len(recordings))),
                    cell(clean(first_few(recordings, _NAMED))),
                ]
            )
    head = ("Cluster", "Submissions", "Recordings", "Which")
    caption = (
        "Recordings that stand in several submissions. In a cluster everybody shares some with "
        "another of it; whose they are the recordings do not say."
    )
    return [make_table(next(tables), caption, head, rows, "rlrl")]


def _listed(links: Sequence[Span]) -> list[str | Span]:
    """Return links with commas between them, those beyond the first few as a number."""
    text: list[str | Span] = [part for link in links[:_NAMED] for part in (link, ", ")][:-1]
    more = len(links) - _NAMED
    return [*text, f" and {more} more"] if more > 0 else text


def _everybody(lines: Sequence[Line], tables: count) -> list[Block]:
    if not lines:
        return []
    head = ("Submission", "Authors", "Points", "%", "Days late", "Remarks", "By hand")
    table = make_table(
        next(tables),
        "All submissions. A name leads to its feedback; grades.csv has every criterion.",
        head,
        [_row(line) for line in lines],
        "llrrrll",
    )
    return [replace(table, finder=True)]


def _row(line: Line) -> list[Cell]:
    failed = line.status == "failed"
    share = 100 * exact(line.points) / exact(line.out_of) if line.out_of else 0
    return [
        cell(_link(line.name)),
        cell(clean(listing(line.authors)) or NOTHING),
        cell(points_text(line.points)),
        cell(f"{math.floor(share)}"),  # 100 is for all points alone
        cell(f"{line.days_late:.3g}" if line.days_late else "0"),
        cell("not graded", "bad") if failed else cell(", ".join(line.codes)),
        cell(", ".join(line.by_hand)),
    ]


def feedback_link(name: str) -> str:
    """Return the address of a submission's feedback, beside `class.html`."""
    return f"feedback/{quote(name, safe='')}/feedback.html"


def _link(name: str) -> Span:
    return Span(clean(name), url=feedback_link(name))


def _picture(pictures: count, name: str, svg: str, *, caption: str, alt: str) -> Picture:
    return Picture(
        number=next(pictures), name=name, caption=spans(caption), alt=alt, svg=svg, width=WIDTH
    )
