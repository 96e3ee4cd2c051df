"""The class at a glance: distribution, difficulty, the most common mistakes, everybody's grade."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from statistics import mean, median
from urllib.parse import quote

import numpy as np

from pipeline import __version__
from pipeline.grading.clusters import Cluster
from pipeline.grading.doubles import Double
from pipeline.grading.feedback_words import TITLES, points_text
from pipeline.grading.grade import CODES, Code, Grade, Outcome
from pipeline.grading.rubric import Rubric
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
    paragraph,
    spans,
)
from pipeline.report.figures import WIDTH, drawing
from pipeline.report.figures_grading import difficulty_figure, distribution_figure
from pipeline.report.html import render_html
from pipeline.report.numbers import NOTHING, listing
from pipeline.report.numbers import count as counted
from pipeline.report.svg import to_svg
from pipeline.report.tables import cell, make_table
from pipeline.report.words import clean

_NAMED = 8  # submissions named beside a mistake
_MOST_FAILED = 8  # whose reasons the summary shows unasked


@dataclass(frozen=True, kw_only=True)
class Line:
    """What the pages and tables of a class need of one grade.

    Attributes
    ----------
    name : of the submission as shown, and of its folder of feedback.
    criteria : outcome and points by criterion.
    by_hand : criteria with points given by hand.
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

    @classmethod
    def of(cls, grade: Grade, *, by_hand: Sequence[str]) -> "Line":
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
            by_hand=tuple(by_hand),
        )


def class_page(
    lines: Sequence[Line],
    *,
    rubric: Rubric,
    doubles: Sequence[Double] = (),
    clusters: Sequence[Cluster] = (),
) -> str:
    """Return `class.html`; same class, same bytes."""
    return render_html(class_document(lines, rubric=rubric, doubles=doubles, clusters=clusters))


def class_document(
    lines: Sequence[Line],
    *,
    rubric: Rubric,
    doubles: Sequence[Double] = (),
    clusters: Sequence[Cluster] = (),
) -> Document:
    """Return the class as a document."""
    graded = [line for line in lines if line.status == "graded"]
    tables, pictures = count(1), count(1)
    with drawing():
        parts = [
            ("summary", "Summary", _summary(lines, graded, doubles)),
            ("points", "Points", _points(graded, rubric, pictures)),
            ("criteria", "Criteria", _criteria(graded, rubric, tables, pictures)),
            ("mistakes", "Most common mistakes", _mistakes(lines, tables)),
            ("shared", "Shared recordings", _shared(lines, clusters, tables)),
            ("class", "Everybody", _everybody(lines, tables)),
        ]
    return Document(
        title=clean(rubric.title) or "The class",
        subtitle="Class grades",
        authors=(),
        sections=tuple(
            Section(id_, title, tuple(blocks)) for id_, title, blocks in parts if blocks
        ),
        footer=f"cartlab {__version__}",
    )


def _summary(
    lines: Sequence[Line], graded: Sequence[Line], doubles: Sequence[Double]
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
    if graded:
        points = [line.points for line in graded]
        out_of = points_text(graded[0].out_of)
        tiles += [
            Tile(spans("Mean"), spans(f"{mean(points):.2f} of {out_of}"), url="#points"),
            Tile(spans("Median"), spans(f"{median(points):.2f} of {out_of}"), url="#points"),
            Tile(spans("With a remark"), spans(str(sum(bool(line.codes) for line in graded))),
                 url="#mistakes"),
        ]  # fmt: skip
    blocks: list[Block] = [Tiles(tuple(tiles))]
    if failed:
        said = "could not be graded; points can be given by hand"
        reasons = bullet_list(
            spans(_link(line.name), f": {clean(line.reason)}", _hand(line)) for line in failed
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


def _points(graded: Sequence[Line], rubric: Rubric, pictures: count) -> list[Block]:
    if not graded:
        return []
    points = [line.points for line in graded]
    low, high = points_text(min(points)), points_text(max(points))
    alt = (
        f"Histogram of the points of {counted(len(points), 'submission')}, from {low} to {high} "
        f"of {points_text(rubric.out_of)}."
    )
    caption = f"How many submissions have how many points; they go from {low} to {high}."
    figure = distribution_figure(points, out_of=rubric.out_of)
    return [_picture(pictures, "distribution", to_svg(figure, name="distribution", alt=alt),
                     caption=caption, alt=alt)]  # fmt: skip


def _criteria(
    graded: Sequence[Line], rubric: Rubric, tables: count, pictures: count
) -> list[Block]:
    """Return how hard each criterion was."""
    if not graded:
        return []
    shares, rows = [], []
    for asked in rubric.criteria:
        had = [line.criteria[asked.id] for line in graded if asked.id in line.criteria]
        outcomes = Counter(outcome for outcome, _ in had)
        share = mean(points for _, points in had) / asked.points if had else 0.0
        shares.append(share)
        rows.append(
            [
                cell(clean(asked.title or asked.id)),
                cell(points_text(asked.points)),
                cell(f"{100 * share:.0f} %"),
                *(cell(str(outcomes[o])) for o in ("pass", "partial", "fail", "skip")),
            ]
        )
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
            caption="The mean share of the points that each criterion earned.",
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
    having: dict[Code, list[Line]] = {}
    for line in lines:
        for code in line.codes:
            having.setdefault(code, []).append(line)
    if not having:
        return [paragraph("No submission has a remark.")] if lines else []
    order = sorted(having, key=lambda code: (-len(having[code]), CODES.index(code)))
    rows = []
    for code in order:
        named = [_link(line.name) for line in having[code]]
        rows.append(
            [
                cell(spans(f"{TITLES[code]} (", Span(code, "code"), ")")),
                cell(str(len(having[code]))),
                cell(f"{100 * len(having[code]) / len(lines):.0f} %"),
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
            more = len(recordings) - _NAMED
            rows.append(
                [
                    cell(str(number)),
                    cell(spans(*_listed(links))),
                    cell(str(len(recordings))),
                    cell(
                        clean(", ".join(recordings[:_NAMED]))
                        + (f" and {more} more" if more > 0 else "")
                    ),
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
    share = 100 * line.points / line.out_of if line.out_of else 0.0
    return [
        cell(_link(line.name)),
        cell(clean(listing(list(line.authors))) or NOTHING),
        cell(points_text(line.points)),
        cell(f"{share:.0f}"),
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
