"""Questions that the data raise, and the students' answers from their notes.

A question is shown in the section with the figures that it is about. It is answered in `notes.md`,
after a heading that begins with the question's id. All other notes are the discussion.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Literal

import numpy as np

from pipeline.estimation.estimates import DAMPING_LIMIT
from pipeline.names import read_name
from pipeline.report.document import Block, Heading, Paragraph, Question, Section, paragraph
from pipeline.report.sections.loops import CLOSE
from pipeline.report.sections.notes import discussion_blocks, even_headings, named
from pipeline.report.sections.parameters import source_text
from pipeline.results import Analysis, HardwareCheck, ParameterRow
from pipeline.words.numbers import listing, percent, significant
from pipeline.words.phrases import phrases
from pipeline.words.text import Span, clean, plain, rich

_WORDS = phrases("questions")
_MOST = 6  # most questions in a report; more would turn it into a questionnaire
_LISTED = 4  # most runs that a question lists


QuestionKind = Literal[
    "sign", "springs", "damping", "damping_same", "signs_differ", "gain", "frequency", "response",
    "assumed", "friction", "sticking", "misfit", "level", "overshoot", "hardware",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Asked:
    """A question in plain text.

    Attributes
    ----------
    section : the section with the figures that the question is about.
    """

    kind: QuestionKind
    id: str
    section: str
    text: str


def ask(analysis: Analysis) -> tuple[Asked, ...]:
    """Return the questions that the data raise, the most important first; none if all is well."""
    # With wrong springs, every other difference has this cause.
    set_up = (*_turned(analysis), *_springs(analysis))
    if any(question.kind == "springs" for question in set_up):
        return set_up
    rules = (
        _turned,
        _damping,
        _friction,
        _gains_and_frequencies,
        _hardware,
        _misfit,
        _sticking,
        _assumed,
    )
    return tuple(question for rule in rules for question in rule(analysis))[:_MOST]


# ------------------------------------------------------------------------ the rules


def _turned(analysis: Analysis) -> Iterator[Asked]:
    turned = [record for record in analysis.records if record.sign_reversed]
    if not turned:
        return
    names = [record.id for record in turned]
    runs = listing(names) if len(names) <= _LISTED else f"{names[0]} and {len(names) - 1} more"
    there = {"step": "steps", "sine": "frequency-response", "closed_loop": "hardware"}
    section = there.get(turned[0].kind, "discussion")
    yield Asked(kind="sign", id="sign", section=section, text=_WORDS.text("sign", runs=runs))


def _springs(analysis: Analysis) -> Iterator[Asked]:
    wrong = [check.message for check in analysis.failed_checks if check.kind == "springs"]
    if wrong:
        yield Asked(
            kind="springs", id="springs", section="parameters", text=" ".join(dict.fromkeys(wrong))
        )


def _inconsistent_rows(analysis: Analysis) -> list[ParameterRow]:
    off = [row for row in analysis.rows if row.consistent is False]
    return sorted(off, key=lambda row: -abs(row.change_percent or 0.0))


def _damping(analysis: Analysis) -> Iterator[Asked]:
    off = [row for row in _inconsistent_rows(analysis) if read_name(row.name).is_ratio]
    if off:
        row, *others = off
        also = listing([f"{other.name} by {_change(other)}" for other in others])
        key: QuestionKind = "damping_same" if row.independent is False else "damping"
        yield _of_row(row, analysis, key, also=f" ({also})" if also else "")


def _gains_and_frequencies(analysis: Analysis) -> Iterator[Asked]:
    for row in _inconsistent_rows(analysis):
        name = read_name(row.name)
        if name.is_ratio or row.initial is None or row.final is None:
            continue
        key: QuestionKind
        if row.initial.value * row.final.value < 0:
            key = "signs_differ"
        elif row.initial.source == "frequency_response":
            key = "response"
        else:
            key = "gain" if name.is_gain else "frequency"
        yield _of_row(row, analysis, key)
        return  # ask only about the largest change


def _of_row(row: ParameterRow, analysis: Analysis, key: QuestionKind, **values: str) -> Asked:
    """Return the question why two estimates differ."""
    initial, final = (source_text(one, steps=analysis.steps) for one in (row.initial, row.final))
    text = _WORDS.text(
        key, name=row.name, change=_change(row), initial=initial, final=final, **values
    )
    return Asked(kind=key, id=row.name, section="parameters", text=text)


def _assumed(analysis: Analysis) -> Iterator[Asked]:
    guessed = [
        (row, row.initial.value, row.final.value)
        for row in analysis.rows
        if row.initial is not None
        and row.final is not None
        and row.final.source == "bode_fit"  # for other sources, the figure has no points
        and row.initial.source == "assumed"
        and not row.extrapolated
        and abs(row.change_percent or 0.0) > DAMPING_LIMIT
    ]
    if not guessed:
        return
    row, initial, final = max(guessed, key=lambda one: abs(one[0].change_percent or 0.0))
    text = _WORDS.text(
        "assumed",
        name=row.name,
        initial=significant(initial, digits=2),
        final=significant(final, digits=2),
        feature="null" if read_name(row.name).is_null else "peak",
        sharper="flatter" if final > initial else "sharper",
    )
    yield Asked(kind="assumed", id=row.name, section="frequency-response", text=text)


def _friction(analysis: Analysis) -> Iterator[Asked]:
    sticking = [d for d in analysis.log_decrements if d.law.is_friction]
    for cart in sorted({decay.cart for decay in sticking}):
        decay = max(
            (d for d in sticking if d.cart == cart),
            key=lambda d: d.law.statistic,
        )
        seen, rise = decay.zeta_at_amplitude, ""
        if seen.shape[1] > 1:
            order = np.argsort(seen[0])
            (small, large), (at_small, at_large) = seen[:, order[[0, -1]]]
            if at_small > at_large > 0:
                sizes = {"small": small, "large": large, "at_small": at_small, "at_large": at_large}
                values = {name: significant(value, digits=2) for name, value in sizes.items()}
                unit = clean(analysis.bench.units.position)
                rise = _WORDS.text("friction_rises", unit=unit, **values)
        text = _WORDS.text("friction", run=decay.experiment, cart=cart, rise=rise)
        yield Asked(kind="friction", id=f"friction-{cart}", section="decays", text=text)


def _sticking(analysis: Analysis) -> Iterator[Asked]:
    stuck = [(g, *g.interval) for g in analysis.step_gains if g.interval is not None]
    if not stuck:
        return
    worst, low, high = max(stuck, key=lambda one: (one[2] - one[1]) / abs(one[0].gain or 1.0))
    text = _WORDS.text(
        "sticking",
        cart=worst.cart,
        run=worst.experiment,
        low=significant(low, digits=3),
        high=significant(high, digits=3),
    )
    yield Asked(kind="sticking", id=f"sticking-{worst.cart}", section="steps", text=text)


def _misfit(analysis: Analysis) -> Iterator[Asked]:
    fit = analysis.fit
    if fit is None or fit.method != "bode_fit" or fit.explains_data:
        return
    found: list[tuple[float, int, float]] = []  # (standard errors, cart, rad/s)
    for response in analysis.frequency_responses:
        residual = np.abs(fit.standardised.get(str(response.cart), np.zeros(0)))
        if residual.size and residual.size == response.omega.size:
            at = int(np.argmax(residual))
            found.append((float(residual[at]), response.cart, float(response.omega[at])))
    if found:
        sigmas, cart, omega = max(found, key=lambda one: one[0])
        text = _WORDS.text(
            "misfit",
            cart=cart,
            omega=significant(omega, digits=3),
            sigmas=significant(sigmas, digits=2),
            chi_square=significant(fit.chi_square_per_dof, digits=3),
        )
        yield Asked(kind="misfit", id="misfit", section="frequency-response", text=text)


def _hardware(analysis: Analysis) -> Iterator[Asked]:
    closed = [check for check in analysis.hardware if check.loop == "closed"]
    design = analysis.feedback
    controlled = [c for c in closed if design is None or c.cart == design.cart] or closed
    off = max(controlled, key=_level_error, default=None)
    if off and _level_error(off) > 0.03:  # share of the level; a larger error raises a question
        yield _of_run(
            off,
            "level",
            measured=significant(off.steady_state_measured, digits=3),
            model=significant(off.steady_state_model, digits=3),
            unit=clean(analysis.bench.units.position),
        )
    over = max(controlled, key=_overshoot_error, default=None)
    # Percent of the step; a larger error raises a question.
    if over and _overshoot_error(over) > 5.0:
        measured, model = percent(over.overshoot_measured), percent(over.overshoot_model)
        yield _of_run(over, "overshoot", measured=measured, model=model)
    far = max(analysis.hardware, key=lambda check: check.nrmse, default=None)
    if far and far.nrmse > CLOSE:
        yield _of_run(far, "hardware", share=percent(100 * far.nrmse))


def _of_run(check: HardwareCheck, key: QuestionKind, **values: str) -> Asked:
    text = _WORDS.text(key, run=check.experiment, cart=check.cart, **values)
    return Asked(kind=key, id=key, section="hardware", text=text)


def _level_error(check: HardwareCheck) -> float:
    if check.steady_state_measured is None or not check.steady_state_model:
        return 0.0
    return abs(check.steady_state_measured / check.steady_state_model - 1)


def _overshoot_error(check: HardwareCheck) -> float:
    if check.overshoot_measured is None or check.overshoot_model is None:
        return 0.0
    return abs(check.overshoot_measured - check.overshoot_model)


def _change(row: ParameterRow) -> str:
    return percent(abs(row.change_percent or 0.0))


# --------------------------------------------------------------------- the answers


def split_notes(
    blocks: Sequence[Block], asked: Iterable[Asked]
) -> tuple[dict[str, tuple[Block, ...]], tuple[Block, ...]]:
    """Return the answers by id, and the notes that answer no question.

    An answer ends at the next heading of the same or a higher level.
    """
    ids = {question.id.lower(): question.id for question in asked}
    answers: dict[str, list[Block]] = {}
    rest: list[Block] = []
    current: list[Block] | None = None
    level = 0
    for block in blocks:
        if isinstance(block, Heading):
            id_ = ids.get(named(plain(block.text)))
            if id_ is not None:
                current, level = answers.setdefault(id_, []), block.level
                continue
            if block.level <= level:
                current = None
        (rest if current is None else current).append(block)
    return {id_: even_headings(found) for id_, found in answers.items() if found}, even_headings(
        rest
    )


def placed(
    sections: Sequence[Section], asked: Sequence[Asked], answers: Mapping[str, tuple[Block, ...]]
) -> tuple[Section, ...]:
    """Return the sections with each question at the end of the section that it is about.

    If the report lacks that section, the question is placed in the discussion.
    """
    there = {section.id for section in sections}
    return tuple(
        replace(
            section,
            blocks=(
                *section.blocks,
                *(
                    Question(
                        id=question.id,
                        text=rich(clean(question.text)),
                        answer=answers.get(question.id, ()),
                    )
                    for question in asked
                    if (question.section if question.section in there else "discussion")
                    == section.id
                ),
            ),
        )
        for section in sections
    )


def open_questions(
    asked: Sequence[Asked], answers: Mapping[str, tuple[Block, ...]], *, by_model: bool = False
) -> list[Paragraph]:
    """Return a paragraph that links to each question and says which ones are unanswered.

    Parameters
    ----------
    by_model : whether the answers are model answers instead of the students' answers.
    """
    if not asked:
        return []
    missing = [question for question in asked if question.id not in answers]
    missed = "none" if not missing else "all" if len(missing) == len(asked) else "some"
    state = "by_model" if by_model else f"{missed}_missing"
    links: list[Span] = []
    for question in asked:
        links += [
            Span(", " if links else ""),
            Span(question.id, "code", url=f"#question-{question.id}"),
        ]
    raised = _WORDS.spans(
        "raised",
        ids=tuple(links),
        state=_WORDS.text(state, count=len(missing)),
    )
    return [paragraph(raised)]


def unanswered(analysis: Analysis) -> list[Asked]:
    """Return the questions that the students' notes do not answer."""
    return _notes_on(analysis)[0]


def misspelt_headings(analysis: Analysis, missing: Iterable[Asked]) -> Iterator[tuple[str, str]]:
    """Yield headings that are almost the id of an unanswered question, each with this id."""
    ids = {question.id.lower(): question.id for question in missing}
    for block in _notes_on(analysis)[1]:
        if isinstance(block, Heading):
            heading = plain(block.text)
            # A cutoff of 0.8 accepts one wrong character of five.
            for id_ in get_close_matches(named(heading), ids, n=1, cutoff=0.8):
                yield heading, ids[id_]


def _notes_on(analysis: Analysis) -> tuple[list[Asked], tuple[Block, ...]]:
    """Return the unanswered questions, and the notes that answer no question."""
    asked = ask(analysis)
    answers, rest = split_notes(discussion_blocks(analysis.discussion or ""), asked)
    return [question for question in asked if question.id not in answers], rest
