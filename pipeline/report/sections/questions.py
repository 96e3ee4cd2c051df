"""Questions that this data raises, and the students' answers from their notes.

A question stands where its figures are. It is answered in `notes.md` under a heading that begins
with the question's id; what stands under no such heading is the discussion.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.names import read_name
from pipeline.report.document import (
    Block,
    Heading,
    Paragraph,
    Question,
    Section,
    Span,
    paragraph,
    plain,
    spans,
)
from pipeline.report.numbers import count, listing, percent, significant
from pipeline.report.sections.notes import discussion_blocks, even_headings
from pipeline.report.words import SOURCES, clean, rich
from pipeline.results import Analysis, HardwareCheck, ParameterRow
from pipeline.stages.compare import DAMPING_LIMIT

_MOST = 6  # a report with more would be a questionnaire
_LISTED = 4  # runs; of more the first
_FAR = 0.10  # of the motion: a difference between bench and model worth a question
_LEVEL = 0.03  # of the level
_OVERSHOOT = 5.0  # percent of the step

_LEAD = re.compile(r"(?:question|q|answer|a)?[\s:.#]*([\w.-]+)", re.IGNORECASE)
_SPELT = str.maketrans({"ω": "omega", "ζ": "zeta", " ": " "})


@dataclass(frozen=True, kw_only=True)
class Asked:
    """A question in plain text; `section` is where its figures are."""

    id: str
    section: str
    text: str


def ask(analysis: Analysis) -> tuple[Asked, ...]:
    """Return what this data raises, the most telling first; nothing where all is well."""
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
    turned = [record for record in analysis.records if record.turned]
    if not turned:
        return
    names = [record.id for record in turned]
    listed = listing(names) if len(names) <= _LISTED else f"{names[0]} and {len(names) - 1} more"
    there = {"step": "steps", "sine": "frequency-response", "closed_loop": "hardware"}
    yield Asked(
        id="sign",
        section=there.get(turned[0].kind, "discussion"),
        text=f"The logged input of {listed} counts the other way than that of your other runs, and "
        "was turned: no delay explains such a motion. What was different there: a plug, the "
        "amplifier, or which signal is logged? State it in submission.toml, input = { sign = … }.",
    )


def _off(analysis: Analysis) -> list[ParameterRow]:
    off = [row for row in analysis.rows if row.consistent is False]
    return sorted(off, key=lambda row: -abs(row.change_percent or 0.0))


def _damping(analysis: Analysis) -> Iterator[Asked]:
    off = [
        row
        for row in _off(analysis)
        if read_name(row.name).is_ratio and row.initial is not None and row.final is not None
    ]
    if not off:
        return
    row, *others = off
    assert row.initial is not None
    assert row.final is not None
    also = listing([f"{other.name} by {_change(other)}" for other in others])
    yield Asked(
        id=row.name,
        section="parameters",
        text=f"{row.name} changed by {_change(row)} from the {_source(row.initial.source)} to the "
        f"{_source(row.final.source)}{f' ({also})' if also else ''}: which of your two methods saw "
        "the larger amplitude, and what does dry friction do to a damping ratio as the amplitude "
        "falls?",
    )


def _gains_and_frequencies(analysis: Analysis) -> Iterator[Asked]:
    for row in _off(analysis):
        if read_name(row.name).is_ratio or row.initial is None or row.final is None:
            continue
        head = (
            f"{row.name} changed by {_change(row)} from the {_source(row.initial.source)} to the "
            f"{_source(row.final.source)}: "
        )
        if row.initial.value * row.final.value < 0:
            tail = "why do their signs differ, and which of your files says which is right?"
        elif read_name(row.name).is_gain:
            tail = (
                "which way would a cart that stops short of where its springs put it move the gain "
                "of a step, and is that the way yours moved?"
            )
        else:
            tail = (
                "which masses and which springs were at work in the one experiment and in the "
                "other, and what would have to differ between them?"
            )
        yield Asked(id=row.name, section="parameters", text=head + tail)
        return  # the largest change stands for the others


def _assumed(analysis: Analysis) -> Iterator[Asked]:
    guessed = [
        row
        for row in analysis.rows
        if row.initial is not None
        and row.final is not None
        and row.initial.source == "assumed"
        and abs(row.change_percent or 0.0) > DAMPING_LIMIT
    ]
    if not guessed:
        return
    row = max(guessed, key=lambda row: abs(row.change_percent or 0.0))
    assert row.initial is not None
    assert row.final is not None
    more = row.final.value > row.initial.value
    feature = "null" if read_name(row.name).is_null else "peak"
    sharper = "flatter" if more else "sharper"
    yield Asked(
        id=row.name,
        section="frequency-response",
        text=f"{row.name} was assumed to be {significant(row.initial.value, digits=2)} and came "
        f"out as {significant(row.final.value, digits=2)}: at which cart and which frequencies do "
        f"your points show that its {feature} is {sharper} than you assumed, and how few points "
        "would have been enough to see it?",
    )


def _friction(analysis: Analysis) -> Iterator[Asked]:
    sticking = [d for d in analysis.log_decrements if d.friction and d.friction.present]
    for cart in sorted({decay.cart for decay in sticking}):
        decay = max(
            (d for d in sticking if d.cart == cart),
            key=lambda d: d.friction.f_statistic if d.friction else 0.0,
        )
        seen = decay.zeta_at_amplitude
        rise = ""
        if seen.shape[1] > 1:
            order = np.argsort(seen[0])
            (small, large), (at_small, at_large) = seen[:, order[[0, -1]]]
            if at_small > at_large > 0:
                unit = clean(analysis.position_unit)
                rise = (
                    f", its damping ratio rising from {significant(at_large, digits=2)} at "
                    f"{significant(large, digits=2)} {unit} to {significant(at_small, digits=2)} "
                    f"at {significant(small, digits=2)} {unit}"
                )
        yield Asked(
            id=f"friction-{cart}",
            section="decays",
            text=f"In {decay.experiment} cart {cart} does not decay exponentially{rise}: which "
            "force on the cart does that, how large is it in input units, and how far from its "
            "springs' rest point may the cart stop?",
        )


def _sticking(analysis: Analysis) -> Iterator[Asked]:
    stuck = [gain for gain in analysis.step_gains if gain.interval is not None]
    if not stuck:
        return
    worst = max(stuck, key=lambda gain: _width(gain.interval) / abs(gain.gain or 1.0))
    assert worst.interval is not None
    low, high = (significant(value, digits=3) for value in worst.interval)
    yield Asked(
        id=f"sticking-{worst.cart}",
        section="steps",
        text=f"Cart {worst.cart} does not settle at one place in {worst.experiment}: its gain lies "
        f"anywhere from {low} to {high}. How large must a step be for the gain to be known to two "
        "digits, and what does the sticking mean for the level that your controller reaches?",
    )


def _width(interval: tuple[float, float] | None) -> float:
    return 0.0 if interval is None else interval[1] - interval[0]


def _misfit(analysis: Analysis) -> Iterator[Asked]:
    fit = analysis.fit
    if fit is None or fit.method != "bode_fit" or fit.explains_data:
        return
    worst: tuple[float, int, float] | None = None  # standard errors, cart, rad/s
    for response in analysis.frequency_responses:
        residual = np.abs(fit.standardised.get(str(response.cart), np.zeros(0)))
        if residual.size != response.omega.size or not residual.size:
            continue
        at = int(np.argmax(residual))
        if worst is None or residual[at] > worst[0]:
            worst = float(residual[at]), response.cart, float(response.omega[at])
    if worst is None:
        return
    sigmas, cart, omega = worst
    yield Asked(
        id="misfit",
        section="frequency-response",
        text=f"Model and measurement are furthest apart at cart {cart} at "
        f"{significant(omega, digits=3)} rad/s, by {significant(sigmas, digits=2)} standard errors "
        f"(χ² per degree of freedom is {significant(fit.chi_square_per_dof, digits=3)}). What do "
        "the carts do there that a chain of masses, springs and dampers does not?",
    )


def _hardware(analysis: Analysis) -> Iterator[Asked]:
    closed = [check for check in analysis.hardware if check.loop == "closed"]
    design = analysis.feedback
    controlled = [c for c in closed if design is None or c.cart == design.cart] or closed
    off_level = max(controlled, key=_level_error, default=None)
    if off_level and _level_error(off_level) > _LEVEL:
        measured, model = (
            significant(value, digits=3)
            for value in (off_level.steady_state_measured, off_level.steady_state_model)
        )
        unit = clean(analysis.position_unit)
        yield Asked(
            id="level",
            section="hardware",
            text=f"In {off_level.experiment} cart {off_level.cart} stops at {measured} {unit} "
            f"where the model stops at {model} {unit}. Which force, or which error of the model, "
            "explains this, how would you tell one from the other, and what would an integrator in "
            "the controller do about it?",
        )
    over = max(controlled, key=_overshoot_error, default=None)
    if over and _overshoot_error(over) > _OVERSHOOT:
        yield Asked(
            id="overshoot",
            section="hardware",
            text=f"In {over.experiment} cart {over.cart} overshoots by "
            f"{percent(over.overshoot_measured)} where the model overshoots by "
            f"{percent(over.overshoot_model)}: is there more or less damping on the bench than in "
            "the model, and which of your measurements says so as well?",
        )
    far = max(analysis.hardware, key=lambda check: check.nrmse, default=None)
    if far and far.nrmse > _FAR:
        yield Asked(
            id="hardware",
            section="hardware",
            text=f"In {far.experiment} cart {far.cart} moves otherwise than the model by "
            f"{percent(100 * far.nrmse)} of the motion. Does the difference lie in the transient, "
            "in the level or all along, and which one change to the model would take most of it "
            "away?",
        )


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


def _source(source: str) -> str:
    return SOURCES.get(source, clean(source))


# --------------------------------------------------------------------- the answers


def split_notes(
    blocks: Sequence[Block], asked: Iterable[Asked]
) -> tuple[dict[str, tuple[Block, ...]], tuple[Block, ...]]:
    """Return the answers by id, and the notes that answer no question.

    An answer ends at the next heading of the same level or above.
    """
    ids = {question.id.lower(): question.id for question in asked}
    answers: dict[str, list[Block]] = {}
    rest: list[Block] = []
    current: list[Block] | None = None
    level = 0
    for block in blocks:
        if isinstance(block, Heading):
            id_ = ids.get(_named(block))
            if id_ is not None:
                current, level = answers.setdefault(id_, []), block.level
                continue
            if block.level <= level:
                current = None
        (rest if current is None else current).append(block)
    return {id_: even_headings(found) for id_, found in answers.items() if found}, even_headings(
        rest
    )


def _named(heading: Heading) -> str:
    """Return the id that a heading begins with, however it is spelt."""
    text = plain(heading.text).translate(_SPELT).strip()
    match = _LEAD.match(text)
    return match[1].rstrip(".:").lower() if match else ""


def placed(
    sections: Sequence[Section], asked: Sequence[Asked], answers: dict[str, tuple[Block, ...]]
) -> tuple[Section, ...]:
    """Return the sections with each question at the end of its own, else of the discussion."""
    there = {section.id for section in sections}
    return tuple(
        Section(
            id=section.id,
            title=section.title,
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
    asked: Sequence[Asked], answers: dict[str, tuple[Block, ...]]
) -> list[Paragraph]:
    """Return a paragraph that leads to every question, and says which are not answered."""
    if not asked:
        return []
    missing = [question for question in asked if question.id not in answers]
    state = (
        "The notes answer all of them"
        if not missing
        else "The notes answer none of them yet"
        if len(missing) == len(asked)
        else f"The notes do not answer {len(missing)} of them yet"
    )
    parts: list[Span] = []
    for question in asked:
        parts += [
            Span(", " if parts else ""),
            Span(question.id, "code", url=f"#question-{question.id}"),
        ]
    raised = f"This data raises {count(len(asked), 'question')}: "
    return [paragraph(spans(raised, tuple(parts), f". {state}."))]


def open_line(analysis: Analysis) -> str:
    """Return one line for the terminal on what is still to be answered, "" where nothing is."""
    asked = ask(analysis)
    answers, _ = split_notes(discussion_blocks(analysis.discussion or ""), asked)
    missing = [question.id for question in asked if question.id not in answers]
    if not missing:
        return ""
    ids = ", ".join(f"“## {id_}”" for id_ in missing)
    return f"{count(len(missing), 'question')} to answer in notes.md, under {ids}"
