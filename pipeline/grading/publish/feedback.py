"""Feedback for one submission: reported and recomputed numbers, reasons, and where to look."""

import math
import re
from collections.abc import Sequence
from html import unescape
from itertools import count
from numbers import Real
from typing import Any

from pipeline import __version__
from pipeline.grading.grade import Criterion, Flag, Outcome
from pipeline.grading.publish.view import GradeView
from pipeline.grading.words import WORDS, points_text
from pipeline.names import read_name
from pipeline.report.document import (
    Block,
    Details,
    Document,
    Heading,
    Picture,
    Section,
    Table,
    Tile,
    Tiles,
    Tone,
    bullet_list,
    cell,
    make_table,
    paragraph,
)
from pipeline.report.html import render_html
from pipeline.setup import Units
from pipeline.words.numbers import NOTHING, percent, significant, typeset, unit_text
from pipeline.words.numbers import count as counted
from pipeline.words.text import Span, capital, clean, name_span, rich, spans

_TITLE = re.compile(r"<title>(.*?)</title>", re.DOTALL)
_NAME = re.compile(r"(omega|zeta|K)(_\w)?")
TONES: dict[Outcome, Tone] = {"pass": "good", "partial": "", "fail": "bad", "skip": "quiet"}
_ENTRY = re.compile(r"([AB])\((\d+)(?:, (\d+))?\)")
_MOST_PERCENT = 1000.0  # a larger difference is given as a ratio
_SHARE = "_percent"  # end of the key of a number that is already a percentage
_HIDDEN = "In this lab you find the numbers yourself, so no computed number is shown here."
_FINEST = 2  # decimals of such a percentage


def feedback_page(view: GradeView, *, figures: Sequence[tuple[str, str]], name: str) -> str:
    """Return `feedback.html`; the same view gives the same bytes.

    Parameters
    ----------
    figures : pairs of file name and SVG text; left out if the view hides numbers, or if a criterion
        is held back.
    """
    grade, rubric = view.grade, view.rubric
    numbers = count(1)
    sections = [Section("summary", "Summary", tuple(_summary(view)))]
    if grade.flags:
        sections.append(Section("remarks", "What to look at", tuple(_remarks(view))))
    if grade.criteria:
        blocks = tuple(_criteria(view, numbers))
        sections.append(Section("criteria", "Criteria, one by one", blocks))
    if figures and not (view.hides_numbers or view.held):
        blocks = tuple(_picture(i, *figure) for i, figure in enumerate(figures, start=1))
        sections.append(Section("figures", "Your recordings", blocks))
    document = Document(
        title=clean(name),
        subtitle=clean(f"Feedback · {rubric.title}" if rubric.title else "Feedback"),
        authors=tuple(clean(author) for author in grade.authors),
        sections=tuple(sections),
        footer=f"cartlab {__version__}",
    )
    return render_html(document)


# -------------------------------------------------------------------------- summary


def _summary(view: GradeView) -> list[Block]:
    grade, overrides = view.grade, view.grade.overrides
    points = f"{points_text(grade.points)} of {points_text(grade.out_of)}"
    points += " so far" if view.held else ""
    criteria = f"{len(overrides)} {'criterion' if len(overrides) == 1 else 'criteria'}"
    by_hand = Tile(spans("Set by hand"), spans(criteria))
    if grade.status == "failed":
        key = "failed_by_hand" if overrides else "unsettled" if grade.unsettled else "failed"
        shown = WORDS.text("unsettled_points") if grade.awaits_grading else points
        tile = Tile(spans("Points"), spans(shown), tone="bad" if key == "failed" else "")
        then = WORDS.text(f"{key}_then")
        first, *others = map(sentence, grade.reason.split("\n"))
        blocks: list[Block] = [paragraph(WORDS.spans(key, why=f"{first} {then}"))]
        if others:
            why = paragraph(WORDS.spans(key, why=WORDS.text("failed_reasons")))
            blocks = [why, bullet_list(map(spans, (first, *others))), paragraph(then)]
        tiles = Tiles((tile, by_hand) if overrides else (tile,))
        return [tiles, *_by_person(view), *blocks, *_notes(view)]
    passed = sum(c.outcome == "pass" for c in grade.criteria)
    tiles = [
        Tile(spans("Points"), spans(points)),
        Tile(
            spans("Criteria passed"),
            spans(f"{passed} of {len(grade.criteria)}"),
            tone="good" if passed == len(grade.criteria) else "",
            url="#criteria" if grade.criteria else "",
        ),
        Tile(
            spans("To look at"),
            spans(counted(len(grade.flags), "flag") if grade.flags else "nothing"),
            tone="" if grade.flags else "good",
            url="#remarks" if grade.flags else "",
        ),
    ]
    if grade.days_late > 0:
        days = f"{grade.days_late:.3g} day{'' if grade.days_late == 1 else 's'}"
        late = f"{days}, −{points_text(grade.deducted)} points"
        tiles.append(Tile(spans("Late"), spans(late), tone="bad" if grade.deducted else ""))
    if overrides:
        tiles.append(by_hand)
    hidden = [paragraph(_HIDDEN)] if view.hides_numbers else []
    return [Tiles(tuple(tiles)), *_by_person(view), *hidden, *_lost(view), *_notes(view)]


def _by_person(view: GradeView) -> list[Block]:
    """Return the changes of the total with their reasons, and what is not in it yet."""
    return [paragraph(rich(sentence(line))) for line in view.person_lines()]


def _lost(view: GradeView) -> list[Block]:
    """Return the table of lost points, the largest loss first."""
    grade = view.grade
    lost = [c for c in grade.criteria if c.id in grade.lost]
    if not lost and grade.open:  # nothing lost, but not all earned
        return []
    if not lost:
        return [paragraph(WORDS.text("earned_all_but_look" if grade.flags else "earned_all"))]
    lost.sort(key=lambda c: c.points - c.out_of)
    where = bullet_list(
        WORDS.spans(
            "lost_here",
            title=clean(c.title or c.id),
            points=points_text(c.points),
            out_of=points_text(c.out_of),
            why=rich(_told(view, c) or sentence(WORDS.text(f"outcome_{c.outcome}"))),
        )
        for c in lost
    )
    return [paragraph(WORDS.text("lost")), where]


def _told(view: GradeView, criterion: Criterion) -> str:
    return " ".join(map(sentence, view.reasons(criterion)))


def _notes(view: GradeView) -> list[Block]:
    notes = bullet_list(rich(sentence(note)) for note in view.notes)
    return [paragraph(WORDS.text("notes")), notes] if view.notes else []


def sentence(text: str) -> str:
    """Return a message with a full stop, and with a capital if it starts with a word."""
    text = clean(text).strip()
    word = text.split(" ", 1)[0]
    if word.isascii() and word.isalpha() and word.islower():
        text = capital(text)
    return text if not text or text[-1] in ".!?" else f"{text}."


# -------------------------------------------------------------------------- remarks


def _remarks(view: GradeView) -> list[Block]:
    blocks: list[Block] = []
    for flag in view.grade.flags:
        text = view.flag_text(flag)
        blocks += [
            Heading(rich(_capital(WORDS.text(f"title_{flag.code}")))),
            *([paragraph(rich(sentence(text)))] if text else []),
            paragraph(WORDS.spans("where", place=rich(WORDS.text(f"place_{flag.code}")))),
        ]
    return blocks


def _capital(text: str) -> str:
    return capital(text) if text.split(" ", 1)[0].isalpha() else text


# ------------------------------------------------------------------------- criteria


def _criteria(view: GradeView, numbers: count) -> list[Block]:
    """Return each criterion with its numbers; those with full points are folded."""
    grade = view.grade
    checks = {criterion.id: criterion.check for criterion in view.rubric.criteria}
    rows = [
        [
            clean(c.title or c.id),
            f"{points_text(c.points)} of {points_text(c.out_of)}",
            cell(WORDS.text(f"outcome_{c.outcome}"), TONES[c.outcome]),
        ]
        for c in grade.criteria
    ]
    rows += [[clean(title), NOTHING, cell("held back", "quiet")] for title in view.held]
    head = WORDS.cells("points_head")
    blocks: list[Block] = [make_table(next(numbers), WORDS.text("points"), head, rows, "lrl")]
    for criterion in grade.criteria:
        title = _capital(clean(criterion.title or criterion.id))
        inside: list[Block] = [paragraph(rich(told))] if (told := _told(view, criterion)) else []
        if not view.hides_numbers and (
            table := numbers_table(
                criterion, check=checks.get(criterion.id, ""), units=grade.units, numbers=numbers
            )
        ):
            inside.append(table)
        if not inside:  # the table above says all that the view shows
            continue
        head = spans(f"{title}: {WORDS.text(f'outcome_{criterion.outcome}')}")
        passed = criterion.outcome == "pass"
        blocks += [Details(head, tuple(inside))] if passed else [Heading(head), *inside]
    return blocks


def numbers_table(
    criterion: Criterion, *, check: str, units: Units | None, numbers: count
) -> Table | None:
    """Return reported and recomputed numbers of a criterion side by side; None without numbers."""
    names = [
        name
        for name in dict.fromkeys((*criterion.expected, *criterion.found))
        if _is_shown(criterion.expected.get(name)) or _is_shown(criterion.found.get(name))
    ]
    if not names:
        return None
    key = f"columns_{check}"
    head = WORDS.cells(key if key in WORDS.by_key else "columns_numbers")
    compared = len(head) == 4
    rows = []
    for name in names[:60]:
        expected, found = criterion.expected.get(name), criterion.found.get(name)
        row = [_label(name, units), _value(name, found), _value(name, expected)]
        rows.append([*row, _difference(name, found, expected)] if compared else row)
    more, title = len(names) - len(rows), _capital(clean(criterion.title or criterion.id))
    caption = WORDS.text("in_numbers_and_more" if more else "in_numbers", title=title, more=more)
    return make_table(next(numbers), caption, head, rows, "lddd" if compared else "ldd")


def evidence_table(flag: Flag, *, units: Units | None, numbers: count) -> Table | None:
    """Return a table of the numbers and texts that support a flag; None if it would be empty."""
    of = flag.evidence.get("parameter")
    found = {
        name: value
        for name, value in flag.evidence.items()
        if _is_shown(value) and value != "" and name != "parameter"
    }
    if not found:
        return None
    unit = _unit(of, units) if isinstance(of, str) else ""
    of_what = f" of {clean(of)}{f', in {unit}' if unit else ''}" if isinstance(of, str) else ""
    heads = [_called(name) for name in found]
    row = [_value(name, value) for name, value in found.items()]
    sides = ("l" if isinstance(value, bool | str) else "r" for value in found.values())
    return make_table(next(numbers), rich(f"The numbers{of_what}."), heads, [row], "".join(sides))


def _is_shown(value: Any) -> bool:
    return isinstance(value, Real | str)


def _label(name: str, units: Units | None) -> str | tuple[Span, ...]:
    """Return the name of a quantity with its unit.

    Parameters of the carts are set as mathematics.
    """
    unit = _unit(name, units)
    shown = name_span(name) if _NAME.fullmatch(name) else Span(_called(name))
    return spans(shown, f" [{unit}]" if unit else "")


def _called(name: str) -> str:
    """Return the name of a quantity, or a readable form of its key in `grade.json`."""
    key = f"quantity_{name}"
    return WORDS.text(key) if key in WORDS.by_key else _capital(clean(name).replace("_", " "))


def _unit(name: str, units: Units | None) -> str:
    """Return the unit of a parameter, the prefilter, or an entry of A or B; "" without a unit."""
    if entry := _ENTRY.fullmatch(name):
        if int(entry[2]) % 2:  # a row for the derivative of a position: its entries are 0 or 1
            return ""
        if entry[1] == "A":
            return "1/s" if int(entry[3]) % 2 == 0 else "1/s²"
        return unit_text(f"{clean(units.position)}/({clean(units.input)} s^2)") if units else ""
    if units is None:
        return "rad/s" if read_name(name).is_frequency else ""
    units = Units(position=clean(units.position), input=clean(units.input))
    return units.stiffness if name == "prefilter" else unit_text(read_name(name).unit(units))


def _value(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Real):
        number = round(float(value), _FINEST) if name.endswith(_SHARE) else float(value)
        # Numbers are rounded to four digits; one that was typed with fewer is shown as typed.
        return min(significant(number), typeset(f"{number:.6g}"), key=len)
    return clean(value)[:200] if isinstance(value, str) else NOTHING


def _difference(name: str, found: Any, expected: Any) -> str:
    """Return the difference of two numbers in words.

    The difference of two percentages is in percentage points; any other difference is relative to
    `expected`.
    """
    if not (_is_number(found) and _is_number(expected)):
        return NOTHING
    if name.endswith(_SHARE):
        apart = round(float(found), _FINEST) - round(float(expected), _FINEST)
        return WORDS.text("points_apart", difference=typeset(f"{apart:+.3g}")) if apart else "0"
    if not expected:
        return NOTHING
    ratio = float(found) / float(expected)
    if _MOST_PERCENT < 100 * abs(ratio) < math.inf:
        return WORDS.text("times_as_large", ratio=significant(ratio))
    return percent(100 * (ratio - 1), signed=True)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


# -------------------------------------------------------------------------- figures


def _picture(number: int, file: str, svg: str) -> Picture:
    alt = alternative(svg)
    return Picture(
        number=number,
        name=file.removesuffix(".svg"),
        caption=rich(alt),
        alt=alt,
        draw=lambda: svg,
    )


def alternative(svg: str) -> str:
    """Return the text alternative of a figure: the title in its SVG."""
    title = _TITLE.search(svg)
    return unescape(title[1]) if title else WORDS.text("some_figure")
