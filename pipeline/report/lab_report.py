"""The report of an analysis: its content in order, its files, and what the command prints."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pipeline import __version__
from pipeline.report.builder import Page, Part, remarks
from pipeline.report.changes import DraftChanges, change_blocks, changes_line
from pipeline.report.document import (
    Block,
    Code,
    Details,
    Document,
    Heading,
    Paragraph,
    Section,
    Table,
    paragraph,
)
from pipeline.report.equations.model import (
    equations_of_motion,
    numeric_state_space,
    numeric_transfer_functions,
    symbolic_state_space,
    symbolic_transfer_functions,
)
from pipeline.report.files import Made, make_files
from pipeline.report.make_report import COMPARE, NAME, PAGE_AND_PDF, Draft, Files
from pipeline.report.pdf import missing_characters
from pipeline.report.sections.housekeeping import (
    assumption_blocks,
    check_blocks,
    skipped_blocks,
    taken_text,
)
from pipeline.report.sections.loops import feedback_blocks, hardware_blocks
from pipeline.report.sections.measurements import (
    decay_blocks,
    dwell_blocks,
    response_blocks,
    step_blocks,
    sweep_blocks,
)
from pipeline.report.sections.notes import discussion_blocks, formula_problems
from pipeline.report.sections.parameters import chain_table, parameter_blocks
from pipeline.report.sections.questions import (
    Asked,
    ask,
    open_questions,
    placed,
    split_notes,
)
from pipeline.report.sections.summary import summary, terminal_summary
from pipeline.results import Analysis, Assumption
from pipeline.words.numbers import count, listing
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import spans, with_symbols

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
    unanswered = [question for question in asked if question.id not in answers]
    made = _WORDS.text("made" if answer else "made_of", version=__version__)
    parts: Sequence[Part] = (
        (
            "summary",
            "Summary",
            lambda page: [*summary(page, open_questions=unanswered), *gap_short(page)],
        ),
        ("changes", "Since the earlier draft", lambda page: change_blocks(page, changes)),
        *(worked or (("model", "The model", _model),)),
        ("parameters", "Initial and final estimates", parameter_blocks),
        ("frequency-response", "Frequency response", response_blocks),
        ("decays", "Free decays", decay_blocks),
        ("steps", "Steps and static gains", step_blocks),
        ("sweeps", "Sweeps", sweep_blocks),
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
        ("warnings", "Remarks", lambda page: remarks(analysis.warnings)),
        ("skipped", "What was skipped", skipped_blocks),
        ("provenance", "Provenance", lambda _: [paragraph(made)]),
    )
    sections = page.sections(parts, doing="report", progress=progress)
    return page.document(
        map(_shorter_in_print, placed(sections, asked, answers)),
        about=f"Identification and control of {count(analysis.bench.n, 'cart')}",
    )


def _shorter_in_print(section: Section) -> Section:
    """Return a section whose long tables only the page has, with the changes of a draft."""
    if section.id == "changes":
        return replace(section, in_print=False)
    if section.id in ("steady-state", "feedback"):
        return replace(section, blocks=tuple(map(_on_the_page, section.blocks)))
    return section


def _on_the_page(block: Block) -> Block:
    """Return a folded table or a program so that the PDF only says where it is."""
    if isinstance(block, Details):
        tables = [str(one.number) for one in block.blocks if isinstance(one, Table)]
        said = paragraph(_WORDS.text("dwells_on_the_page", tables=listing(tables)))
        return replace(block, in_print=(said,))
    if isinstance(block, Code):
        said = paragraph(_WORDS.text("code_on_the_page"))
        return Details(_WORDS.spans("code"), (block,), in_print=(said,))
    return block


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
    from pipeline.report import gap_report

    return (
        lambda _: gap_report.gap_in_short(gap),
        lambda page: gap_report.augmented_hardware_blocks(page, gap),
        lambda page: gap_report.gap_blocks(page, gap),
    )


def _nothing(_: Page) -> list[Block]:
    return []


# ----------------------------------------------------------------------------------------- files


def make_draft(
    analysis: Analysis,
    *,
    gap: "Gap | None" = None,
    changes: DraftChanges | None = None,
    files: Files = PAGE_AND_PDF,
    progress: Progress = silent,
) -> Draft:
    """Return the report of an analysis."""
    lines = (
        changes and with_symbols(changes_line(changes)),
        *(f"notes.md: {line}" for line in formula_problems(analysis.discussion or "")),
    )
    return Draft(
        files=_make_files(analysis, gap=gap, changes=changes, files=files, progress=progress),
        summary=terminal_summary(analysis),
        remarks=tuple(filter(None, lines)),
        findings=_findings(analysis, changes),
    )


def _findings(analysis: Analysis, changes: DraftChanges | None) -> dict[str, Any]:
    """Return what a report assumed, asked and found wrong, as JSON for the desk."""

    def describe(one: Assumption) -> dict[str, Any]:
        return {
            "key": one.key,
            "about": one.about,
            "value": one.value,
            "support": one.support,
            "taken": taken_text(one),
            "why": with_symbols(one.reason),
        }

    assumptions = analysis.assumptions
    return {
        "questions": [
            {"id": one.id, "section": one.section, "text": with_symbols(one.text)}
            for one in ask(analysis)
        ],
        "assumed": [describe(one) for one in assumptions if one.origin != "stated"],
        "contradicted": [describe(one) for one in assumptions if one.support == "contradicted"],
        "changes": with_symbols(changes_line(changes)) if changes else "",
        "failed": [with_symbols(check.message) for check in analysis.failed_checks],
        "status": {"state": analysis.status.state, "count": analysis.status.count},
        "turned": {
            one.id: 1 if one.input_scale > 0 else -1
            for one in analysis.records
            if one.sign_reversed
        },
        "unreadable": dict(analysis.unreadable),
    }


def _make_files(
    analysis: Analysis,
    *,
    gap: "Gap | None",
    changes: DraftChanges | None,
    files: Files,
    progress: Progress,
) -> Made:
    """Return `report.html`, `figures/*.svg` and the other requested pages.

    The same analysis gives the same bytes. If the PDF's fonts lack some characters, the report and
    `progress` name them. `progress` also receives the name of each section.
    """
    if files.pdf and (lost := missing_characters(_students_text(analysis))):
        warning = f"report.pdf: its fonts lack {lost}; report.html shows them"
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
        progress(warning)
    document = build_document(analysis, gap=gap, changes=changes, progress=progress)
    progress("report: writing its files")
    if not files.plots:
        return make_files(document, name=NAME, pdf=files.pdf)
    # Imported late, because it loads the catalogue of effects.
    from pipeline.report.compare import make_page

    plots = make_page(analysis, gap=gap, report=True, progress=progress)
    document = replace(document, plots=COMPARE)
    return {**make_files(document, name=NAME, pdf=files.pdf), COMPARE: plots}


def _students_text(analysis: Analysis) -> str:
    """Return all text in the report that was written by students."""
    authors = (part for author in analysis.authors for part in author)
    records = (record.id for record in analysis.records)
    units = vars(analysis.bench.units).values()
    notes = analysis.discussion or ""
    return "".join((analysis.title, analysis.section, *authors, *records, *units, notes))
