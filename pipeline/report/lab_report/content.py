"""The content of a report in order: turn an `Analysis` into a `Document`."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from pipeline import __version__
from pipeline.report.document import Block, Document, Heading, Paragraph, paragraph
from pipeline.report.equations.model import (
    equations_of_motion,
    numeric_state_space,
    numeric_transfer_functions,
    symbolic_state_space,
    symbolic_transfer_functions,
)
from pipeline.report.lab_report.changes import DraftChanges, change_blocks
from pipeline.report.render.builder import Part
from pipeline.report.sections.housekeeping import (
    assumption_blocks,
    check_blocks,
    provenance_blocks,
    skipped_blocks,
)
from pipeline.report.sections.loops import feedback_blocks, hardware_blocks
from pipeline.report.sections.measurements import (
    decay_blocks,
    dwell_blocks,
    response_blocks,
    step_blocks,
)
from pipeline.report.sections.notes import discussion_blocks
from pipeline.report.sections.page import Page, remarks
from pipeline.report.sections.parameters import chain_table, parameter_blocks
from pipeline.report.sections.questions import Asked, ask, open_questions, placed, split_notes
from pipeline.report.sections.summary import summary
from pipeline.results import Analysis
from pipeline.words.numbers import count
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import spans

if TYPE_CHECKING:
    from pipeline.gap.types import Gap

Blocks = Callable[[Page], list[Block]]

_WORDS = phrases("report")


def build_document(
    analysis: Analysis,
    *,
    gap: "Gap | None" = None,
    worked: Sequence[Part] = (),
    answer: Callable[[Asked], Paragraph] | None = None,
    changes: DraftChanges | None = None,
    progress: Progress = silent,
) -> Document:
    """Return the report of an analysis; sections with nothing to show are left out.

    Parameters
    ----------
    gap : the gap analysis of the same data, if there is one.
    worked : sections with derivations; they replace the section on the model.
    answer : function that returns the model answer to a question; if given, the students' notes are
        left out.
    changes : differences from an earlier draft.
    """
    page = Page(analysis)
    gap_short, gap_replays, gap_verdict = _about_gap(gap)
    asked = ask(analysis)
    notes = "" if answer else analysis.discussion or ""
    written, rest = split_notes(discussion_blocks(notes), asked)
    answers = {one.id: (answer(one),) for one in asked} if answer else written
    made = _WORDS.text("made", version=__version__)
    parts: Sequence[Part] = (
        ("summary", "Summary", lambda page: [*summary(page), *gap_short(page)]),
        ("changes", "Since the earlier draft", lambda page: change_blocks(page, changes)),
        *(worked or (("model", "The model", _model),)),
        ("parameters", "Initial and final estimates", parameter_blocks),
        ("frequency-response", "Frequency response", response_blocks),
        ("decays", "Free decays", decay_blocks),
        ("steps", "Steps and static gains", step_blocks),
        ("steady-state", "Sinusoidal steady state", dwell_blocks),
        ("feedback", "State feedback", feedback_blocks),
        (
            "hardware",
            "Model and measurement",
            lambda page: [*hardware_blocks(page), *gap_replays(page)],
        ),
        ("gap", "What the linear model leaves out", gap_verdict),
        ("checks", "Consistency checks", check_blocks),
        ("assumptions", "Assumptions", assumption_blocks),
        (
            "discussion",
            "Discussion",
            lambda page: [*open_questions(asked, answers, by_model=answer is not None), *rest],
        ),
        ("warnings", "Warnings", lambda page: remarks(analysis.warnings)),
        ("skipped", "What was skipped", skipped_blocks),
        ("provenance", "Provenance", lambda page: provenance_blocks(page, made)),
    )
    sections = page.sections(parts, doing="report", progress=progress)
    return page.document(
        placed(sections, asked, answers),
        about=f"Identification and control of {count(analysis.bench.n, 'cart')}",
    )


# ----------------------------------------------------------------------- model


def _model(page: Page) -> list[Block]:
    analysis = page.analysis
    blocks: list[Block] = [
        paragraph(_WORDS.text("model", drive=page.drive, position=page.position)),
        equations_of_motion(analysis.bench.springs),
        Heading(spans("State space")),
        symbolic_state_space(analysis.bench.springs),
    ]
    chain = analysis.chain
    if chain:
        blocks += [paragraph(_WORDS.text("state_numbers"))]
        blocks += numeric_state_space(chain)
    symbolic = symbolic_transfer_functions(analysis.bench.springs)
    if symbolic or chain:
        blocks.append(Heading(spans("Transfer functions")))
    if symbolic:
        blocks.append(symbolic)
    if chain:
        blocks += [paragraph("With the identified numbers:"), numeric_transfer_functions(chain)]
    if chain and analysis.fit:
        blocks.append(chain_table(page, chain, std=analysis.fit.std))
    return blocks


# ------------------------------------------------------------------------- gap


def _about_gap(gap: "Gap | None") -> tuple[Blocks, Blocks, Blocks]:
    """Return three functions that build blocks on the gap, for three places in the report."""
    if gap is None:
        return _nothing, _nothing, _nothing
    # Imported late, because it loads the catalogue of effects.
    from pipeline.report.gap import section

    return (
        lambda _: section.gap_in_short(gap),
        lambda page: section.augmented_hardware_blocks(page, gap),
        lambda page: section.gap_blocks(page, gap),
    )


def _nothing(_: Page) -> list[Block]:
    return []
