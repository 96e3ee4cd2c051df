"""What a report says, in order: an `Analysis` as a `Document`."""

from collections.abc import Callable, Sequence

from pipeline import __version__
from pipeline.gap.types import Gap
from pipeline.report.document import (
    Block,
    Details,
    Document,
    Heading,
    Section,
    Span,
    bullet_list,
    paragraph,
    spans,
)
from pipeline.report.draft.changes import DraftChanges, change_blocks
from pipeline.report.equations.model import (
    equations_of_motion,
    numeric_state_space,
    numeric_transfer_functions,
    symbolic_state_space,
    symbolic_transfer_functions,
)
from pipeline.report.figures.style import drawing
from pipeline.report.gap.section import augmented_hardware_blocks, gap_blocks, gap_in_short
from pipeline.report.numbers import count, percent
from pipeline.report.phrases import phrases
from pipeline.report.sections.loops import feedback_blocks, hardware_blocks
from pipeline.report.sections.measurements import (
    decay_blocks,
    dwell_blocks,
    response_blocks,
    step_blocks,
)
from pipeline.report.sections.notes import discussion_blocks
from pipeline.report.sections.page import Page, remarks
from pipeline.report.sections.questions import ask, open_questions, placed, split_notes
from pipeline.report.sections.summary import summary
from pipeline.report.tables.housekeeping import check_table, file_table
from pipeline.report.tables.parameters import (
    fitted_chain_table,
    parameter_notes,
    parameter_table,
    reported_table,
)
from pipeline.report.words import clean, names_spans, rich, stage_name
from pipeline.results import Analysis

Part = tuple[str, str, Callable[[Page], list[Block]]]  # anchor, title, blocks

_WORDS = phrases("report")
_NO_CHANGE = 0.05  # percent: nothing to speak of


def build_document(
    analysis: Analysis,
    *,
    gap: Gap | None = None,
    worked: Sequence[Part] = (),
    changes: DraftChanges | None = None,
    progress: Callable[[str], None] | None,
) -> Document:
    """Return the report of an analysis; sections that have nothing to show are left out.

    `gap` is the gap analysis of the same data, where there is one; `worked` are sections that
    stand in the place of the one on the model; `changes` is what an earlier draft had otherwise.
    """
    page = Page.of(analysis)
    asked = ask(analysis)
    answers, rest = split_notes(discussion_blocks(analysis.discussion or ""), asked)
    parts: Sequence[Part] = (
        ("summary", "Summary", lambda page: [*summary(page), *gap_in_short(gap)]),
        ("changes", "Since the earlier draft", lambda page: change_blocks(page, changes)),
        *(worked or (("model", "The model", _model),)),
        ("parameters", "Initial and final estimates", _parameters),
        ("frequency-response", "Frequency response", response_blocks),
        ("decays", "Free decays", decay_blocks),
        ("steps", "Steps and static gains", step_blocks),
        ("steady-state", "Sinusoidal steady state", dwell_blocks),
        ("feedback", "State feedback", feedback_blocks),
        ("hardware", "Model and measurement", lambda page: _hardware(page, gap)),
        ("gap", "What the linear model leaves out", lambda page: gap_blocks(page, gap)),
        ("checks", "Consistency checks", _checks),
        ("discussion", "Discussion", lambda page: [*open_questions(asked, answers), *rest]),
        ("warnings", "Warnings", _warnings),
        ("skipped", "What was skipped", _skipped),
        ("provenance", "Provenance", _provenance),
    )
    sections = []
    with drawing():
        for id_, title, blocks_of in parts:
            if progress:
                progress(f"report: {title.lower()}")
            if blocks := blocks_of(page):
                sections.append(Section(id=id_, title=title, blocks=tuple(blocks)))
    return page.document(
        placed(sections, asked, answers),
        about=f"Identification and control of {count(analysis.carts, 'cart')}",
        untitled=f"Identification of {count(analysis.carts, 'cart')}",
    )


# ----------------------------------------------------------------------- model


def _model(page: Page) -> list[Block]:
    analysis = page.analysis
    blocks: list[Block] = [
        paragraph(_WORDS.text("model", drive=page.drive, position=page.position)),
        equations_of_motion(analysis.springs),
        Heading(spans("State space")),
        symbolic_state_space(analysis.springs),
    ]
    chain = analysis.chain
    if chain:
        blocks += [paragraph(_WORDS.text("state_numbers"))]
        blocks += numeric_state_space(chain)
    blocks.append(Heading(spans("Transfer functions")))
    if symbolic := symbolic_transfer_functions(analysis.springs):
        blocks.append(symbolic)
    if chain:
        blocks += [paragraph("With the identified numbers:"), numeric_transfer_functions(chain)]
    if analysis.fit:
        blocks.append(
            fitted_chain_table(
                analysis.fit,
                number=page.table_number(),
                position_unit=page.position,
                input_unit=page.drive,
            )
        )
    return blocks


def _parameters(page: Page) -> list[Block]:
    rows = page.analysis.rows
    if not rows:
        return []
    blocks: list[Block] = [
        paragraph(_WORDS.text("parameters")),
        parameter_table(rows, number=page.table_number(), carts=page.analysis.carts),
    ]
    if remarks := parameter_notes(rows):
        blocks.append(bullet_list(remarks))
    if staged := _staged_differences(page):
        blocks.append(staged)
    if any(page.analysis.reported.values()):
        table = reported_table(rows, page.analysis.reported, number=page.table_number())
        blocks += [Heading(spans(_WORDS.text("reported"))), table]
    return blocks


def _staged_differences(page: Page) -> Block | None:
    """Say where the fit cart by cart ended up elsewhere than the joint fit."""
    fit = page.analysis.fit
    if fit is None or fit.chain.n == 1:
        return None
    finals = {name: estimate.value for name, estimate in fit.parameters.items()}
    changes = {
        name: 100 * (value / finals[name] - 1)
        for name, value in fit.staged.items()
        if finals.get(name)
    }
    if not changes:
        return None
    worst = max(changes, key=lambda name: abs(changes[name]))
    if abs(changes[worst]) < _NO_CHANGE:
        return paragraph(_WORDS.text("staged_same"))
    return paragraph(
        _WORDS.text("staged_differs", share=percent(abs(changes[worst]))),
        names_spans([worst]),
        _WORDS.text("joint_reported"),
    )


def _hardware(page: Page, gap: Gap | None) -> list[Block]:
    return [*hardware_blocks(page), *augmented_hardware_blocks(page, gap)]


# ----------------------------------------------------------------- housekeeping


def _checks(page: Page) -> list[Block]:
    """Return what failed in sight, and the rest under a line that can be opened."""
    checks = page.analysis.checks
    failed = [check for check in checks if check.outcome == "fail"]
    others = [check for check in checks if check.outcome != "fail"]
    passed = sum(check.outcome == "pass" for check in others)
    blocks: list[Block] = []
    if failed:
        blocks.append(
            check_table(failed, "Consistency checks that failed.", number=page.table_number())
        )
    if others:
        title = f"{count(passed, 'check')} passed"
        if unchecked := len(others) - passed:
            title += f", {unchecked} could not be done"
        table = check_table(
            others, "Consistency checks that passed or could not be done.",
            number=page.table_number(),
        )  # fmt: skip
        blocks.append(Details(spans(title), (table,)))
    return blocks


def _warnings(page: Page) -> list[Block]:
    return remarks(list(page.analysis.warnings))


def _skipped(page: Page) -> list[Block]:
    skipped = page.analysis.skipped
    if not skipped:
        return []
    return [
        bullet_list(
            spans(Span(f"{stage_name(skip.stage)}: ", "strong"), rich(clean(skip.reason)))
            for skip in skipped
        )
    ]


def _provenance(page: Page) -> list[Block]:
    made = paragraph(_WORDS.text("made", version=__version__))
    if not page.analysis.files:
        return [made]
    files = file_table(page.analysis, number=page.table_number())
    return [made, Details(spans(count(len(page.analysis.files), "data file")), (files,))]
