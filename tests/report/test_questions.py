"""The report asks questions that its data raise, and shows each answer next to its question."""

import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import pypdf
import pytest

from pipeline.report.document import (
    Document,
    Paragraph,
    Question,
    Section,
    paragraph,
    plain_lines,
)
from pipeline.report.html import render_html
from pipeline.report.lab_report import build_document
from pipeline.report.pdf import render_pdf
from pipeline.report.sections.notes import discussion_blocks
from pipeline.report.sections.questions import (
    ask,
    misspelt_headings,
    placed,
    split_notes,
    unanswered,
)
from pipeline.report.sections.summary import next_steps
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis, Estimate, StepGain
from pipeline.submission import load_submission, new_submission
from pipeline.words.text import plain, spans
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.examples import analysed
from tests.helpers.ucsd import write_two_cart_submission

SECTIONS = (
    "parameters", "frequency-response", "decays", "steps", "feedback", "hardware", "discussion"
)  # fmt: skip


def well(carts: int = 2) -> Analysis:
    """Return an analysis in which all results agree."""
    analysis = make_analysis(carts)
    rows = tuple(replace(row, consistent=True, change_percent=1.0) for row in analysis.rows)
    decays = tuple(
        replace(decay, law=replace(decay.law, name="exponential"))
        for decay in analysis.log_decrements
    )
    hardware = tuple(
        replace(
            check,
            nrmse=0.01,
            overshoot_measured=check.overshoot_model,
            steady_state_measured=check.steady_state_model,
        )
        for check in analysis.hardware
    )
    return replace(analysis, rows=rows, log_decrements=decays, hardware=hardware)


def off(name: str, percent: float, **initial) -> Analysis:
    """Return an analysis in which one parameter differs between initial and final estimate."""
    analysis = well()
    rows = []
    for row in analysis.rows:
        if row.name == name and row.final:
            value = row.final.value / (1 + percent / 100)
            source = initial.get("source", "log_decrement")
            row = replace(
                row,
                initial=Estimate(value=value, std=None, source=source),
                change_percent=percent,
                consistent=None if source == "assumed" else False,
            )
        rows.append(row)
    return replace(analysis, rows=tuple(rows))


def test_nothing_is_asked_if_all_results_agree():
    """If all results agree, the report asks no question."""
    analysis = well()
    assert ask(analysis) == ()
    assert questions_of(analysis) == []
    assert unanswered(analysis) == []


@pytest.mark.parametrize(
    ("name", "percent", "source", "section", "words"),
    [
        ("zeta_b", 65.0, "log_decrement", "parameters", "65.0 %"),
        ("K_1", 40.0, "log_decrement", "parameters", "equilibrium"),
        ("omega_1", 40.0, "log_decrement", "parameters", "masses"),
        ("zeta_b", -67.0, "assumed", "frequency-response", "sharper"),
        ("zeta_a", 148.0, "assumed", "frequency-response", "flatter"),
        ("zeta_a", 20.0, "assumed", "", ""),
    ],
)
def test_a_changed_parameter_asks_about_its_likely_cause(name, percent, source, section, words):
    """A parameter that changed raises one question, about its cause and where the data show it.

    A damping that was only assumed has to be far off; no fit to time records asks for a Bode plot.
    """
    analysis = off(name, percent, source=source)
    asked = ask(analysis)
    assert [(q.id, q.section) for q in asked] == ([(name, section)] if section else [])
    assert all(words in question.text for question in asked)
    rows = tuple(
        replace(row, final=row.final and replace(row.final, source="time_fit"))
        for row in analysis.rows
    )
    assert len(ask(replace(analysis, rows=rows))) == (source != "assumed")


def test_level_overshoot_and_shape_raise_separate_questions():
    """If level, overshoot and shape differ from the model, each raises its own question.

    Each question gives the measured and the simulated number.
    """
    analysis = well()
    first, *others = analysis.hardware
    assert first.steady_state_model is not None
    assert first.overshoot_model is not None
    worse = replace(
        first,
        cart=analysis.feedback.cart if analysis.feedback else 1,
        nrmse=0.23,
        steady_state_measured=0.9 * first.steady_state_model,
        overshoot_measured=first.overshoot_model + 9.0,
    )
    asked = ask(replace(analysis, hardware=(worse, *others)))
    assert [question.id for question in asked] == ["level", "overshoot", "hardware"]
    assert {question.section for question in asked} == {"hardware"}
    assert "21.0 %" in asked[1].text
    assert "23.0 %" in asked[2].text


def test_a_cart_that_sticks_is_asked_about_with_its_interval():
    """If a cart sticks, the question gives both ends of the gain's interval."""
    analysis = well()
    stuck = replace(analysis.step_gains[0], interval=(23.1, 26.4))
    assert isinstance(stuck, StepGain)
    (question,) = ask(replace(analysis, step_gains=(stuck,)))
    assert question.id == "sticking-1"
    assert re.search(r"23\.1 \w+ 26\.4", question.text)


def test_a_poor_fit_asks_about_its_worst_point():
    """If a fit's error exceeds the noise, a question names the worst-fitting cart and frequency."""
    analysis = well()
    assert analysis.fit is not None
    response = analysis.frequency_responses[1]
    residual = {str(r.cart): np.zeros(r.omega.size) for r in analysis.frequency_responses}
    residual[str(response.cart)][3] = -8.1
    fit = replace(analysis.fit, chi_square_per_dof=5.0, standardised=residual)
    (question,) = ask(replace(analysis, fit=fit))
    assert question.id == "misfit"
    for number in (f"cart {response.cart}", f"{response.omega[3]:.3g} rad/s", "8.1"):
        assert number in question.text


# ------------------------------------------------------------------------- answers


def questions_of(analysis: Analysis) -> list[tuple[str, Question]]:
    """Return the questions of a report, each with its section."""
    asked = ask(analysis)
    answers, _ = split_notes(discussion_blocks(analysis.discussion or ""), asked)
    sections = [Section(id=id_, title=id_, blocks=()) for id_ in SECTIONS]
    return [
        (section.id, block)
        for section in placed(sections, asked, answers)
        for block in section.blocks
        if isinstance(block, Question)
    ]


NOTES = """
## Discussion

The bench squeaks.

## {heading}

The decay saw more.

- Half a centimetre.

### In detail

Much more.

## What we would do next

Oil it.
"""


def test_an_answer_is_shown_beside_its_question():
    """An answer is shown next to its question; other notes stay in the discussion."""
    analysis = replace(off("zeta_b", 65.0), discussion=NOTES.format(heading="zeta_b"))
    ((section, question),) = questions_of(analysis)
    assert section == "parameters"
    first = question.answer[0]
    assert isinstance(first, Paragraph)
    assert plain(first.text) == "The decay saw more."
    assert len(question.answer) == 4  # includes the smaller heading and its text


@pytest.mark.parametrize(
    "heading", ["zeta_b", "Question zeta_b", "Q: zeta_b: amplitudes", "`zeta_b`", "ζ_b", "ZETA_B."]
)
def test_an_answer_is_found_under_any_spelling_of_its_id(heading):
    """An answer is found under any spelling of its question's id; without a question it stays."""
    notes = discussion_blocks(NOTES.format(heading=heading))
    analysis = replace(off("zeta_b", 65.0), discussion=NOTES.format(heading=heading))
    answers, rest = split_notes(notes, ask(analysis))
    assert {name: len(blocks) for name, blocks in answers.items()} == {"zeta_b": 4}
    assert len(rest) == len(notes) - 5  # the answer and its heading
    assert unanswered(analysis) == []
    assert len(split_notes(notes, ask(well()))[1]) == len(notes)


def test_an_empty_heading_is_no_answer():
    """A heading without text below it counts as no answer."""
    analysis = replace(off("zeta_b", 65.0), discussion="## zeta_b\n\n## Rest\n\nText.\n")
    ((_, question),) = questions_of(analysis)
    assert question.answer == ()
    assert [question.id for question in unanswered(analysis)] == ["zeta_b"]


def test_page_and_print_mark_the_place_and_show_the_answer():
    """For an open question, page and print name the heading to write under.

    For an answered question they show the answer.
    """
    analysis = off("zeta_b", 65.0)
    pages, prints = {}, {}
    for name, discussion in (("open", None), ("done", "## zeta_b\n\n<b>Ours</b> & *more*\n")):
        whole = build_document(replace(analysis, discussion=discussion))
        shown = [
            section for section in whole.sections if section.id in ("parameters", "discussion")
        ]
        document = replace(whole, sections=tuple(shown))
        pages[name] = render_html(document)
        printed = pypdf.PdfReader(BytesIO(render_pdf(document))).pages
        prints[name] = " ".join(" ".join(page.extract_text().split()) for page in printed)
    answer = {"page": "&lt;b&gt;Ours&lt;/b&gt; &amp;", "print": "<b>Ours</b> &"}
    for name, shown in (("page", pages), ("print", prints)):
        assert "## zeta_b" in shown["open"]
        assert [answer[name] in shown[state] for state in ("open", "done")] == [False, True]
        assert "To be" not in shown["done"]
    for page in pages.values():  # the list in the discussion links to every question
        assert page.count('href="#question-zeta_b"') == page.count('id="question-zeta_b"') == 1


@pytest.mark.parametrize("answered", [False, True])
def test_a_question_is_printed_with_its_answer(answered):
    """In print, a question is on the same page as its answer, wherever pages break."""
    answer = (paragraph("Our answer. " + "It sticks. " * 40),) if answered else ()
    question = Question(id="q", text=spans("Why so? " * 30), answer=answer)
    line = paragraph("A line.")
    blocks = tuple(block for n in range(60) for block in (question, *[line] * (n % 7)))
    section = Section(id="s", title="S", blocks=blocks)
    document = Document(title="T", subtitle="", authors=(), sections=(section,), footer="")
    pages = pypdf.PdfReader(BytesIO(render_pdf(document))).pages
    texts = [page.extract_text() for page in pages]
    asked, said = ("Question.", "Our answer." if answered else "To be answered")
    assert sum(text.count(asked) for text in texts) == 60
    assert [text.count(asked) for text in texts] == [text.count(said) for text in texts]


def test_a_new_submission_explains_how_to_answer(tmp_path):
    """A new submission explains in a comment how to answer; the comment is in no report."""
    new_submission(tmp_path / "team", carts=2)
    notes = tmp_path / "team" / "notes.md"
    assert "## zeta_b" in notes.read_text(encoding="utf-8")
    notes.write_text(notes.read_text(encoding="utf-8") + "\nOur words.\n", encoding="utf-8")
    source = EXAMPLES / "two-cart" / "submission.toml"
    toml = re.sub(r"\[\[experiments\]\].*", "", source.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "team" / "submission.toml").write_text(toml, encoding="utf-8")
    discussion = load_submission(tmp_path / "team").discussion
    assert discussion is not None
    assert discussion.strip() == "Our words."


def test_the_three_cart_example_answers_its_question():
    """The one question raised by the shipped three-cart example is answered in its notes."""
    analysis = analysed("three-cart")
    ((section, question),) = questions_of(analysis)
    assert (section, question.id) == ("frequency-response", "zeta_a")
    assert question.answer


def test_real_carts_raise_friction_and_damping(tmp_path, real_data):
    """Real data of two carts raise at most six questions.

    They are about the sign, dampings, dry friction and the bench.
    """
    folder = write_two_cart_submission(tmp_path / "real", real_data, steps=(2, 3, 4, 5))
    ids = [question.id for question in ask(analyse(load_submission(folder)))]
    assert ids[:4] == ["sign", "zeta_2", "friction-1", "friction-2"]
    assert "hardware" in ids
    assert len(ids) <= 6


@pytest.mark.parametrize(
    ("heading", "is_near"), [("zeta-b", True), ("Why zeta?", False), ("Rest", False)]
)
def test_a_misspelt_id_is_named(heading, is_near):
    """Only a heading that is almost the id of an unanswered question is named."""
    analysis = replace(off("zeta_b", 65.0), discussion=f"## {heading}\n\nText.\n")
    missing = unanswered(analysis)
    assert [question.id for question in missing] == ["zeta_b"]
    near = [(heading, "zeta_b")] if is_near else []
    assert [*misspelt_headings(analysis, missing)] == near
    assert "zeta_b" in plain_lines([next_steps(analysis, open_questions=missing)])
