"""LaTeX between dollars is typeset in the page and the PDF, and cannot do anything else."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.report.document import Code, Formula, Paragraph
from pipeline.report.equations.latex import LatexError, read_latex
from pipeline.report.html import render_html
from pipeline.report.pdf import render_pdf
from pipeline.report.sections.notes import formula_problems, note_blocks
from pipeline.words.math import Math, to_mathml, to_text
from tests.report.test_notes import document_of, page


@pytest.mark.parametrize(
    ("latex", "tags"),
    [
        (r"\omega_n = \sqrt{\frac{k}{m}}", "msub msqrt mfrac"),
        (r"\dot{x}_1 + \hat\theta + \vec v", "mover"),
        (r"\sum_{i=1}^{n} x_i^2", "munderover msubsup"),
        (r"\begin{bmatrix}1&2\\3&4\end{bmatrix}", "mtable mtr mtd"),
        (r"\left\{\frac{a}{b}\right.", "mfrac"),
        (r"\begin{cases}1 & v > 0\\ 0\end{cases}", "mtable"),
        (r"\begin{aligned}a &= b\\ c &= d\end{aligned}", "mtable"),
        (r"12.5\,\mathrm{rad/s} \quad \text{for all } x", "mtext mn"),
        (r"\sqrt[3]{x} \le \lim_{t\to\infty} f'(t)", "mroot munder msup"),
    ],
)
def test_what_a_lab_report_needs_is_typeset(latex, tags):
    """Fractions, roots, sums, matrices, systems of equations and units are typeset."""
    mathml = to_mathml(read_latex(latex, display=True))

    assert {f"<{tag}" for tag in tags.split()} <= set(re.findall(r"<\w+", mathml))
    assert "\\" not in mathml
    assert not formula_problems(f"$${latex}$$")


def test_inline_and_displayed_formulas_become_mathematics():
    """A formula is read in the text, on its own line, in a table and in a heading."""
    text, shown, table = note_blocks(
        "It is $\\zeta_b$ *here*.\n\n$$\nx^2\n$$\n\n| $a$ |\n|---|\n| 1 |"
    )

    assert isinstance(text, Paragraph)
    assert [(span.text, span.math is not None) for span in text.text][:2] == [
        ("It is ", False),
        ("ζ_b", True),
    ]
    assert isinstance(shown, Formula)
    assert to_text(shown.math) == "x^2"
    assert "<math" in page("| $a$ |\n|---|\n| 1 |")
    assert table.kind == "table"


@pytest.mark.parametrize(
    "text", ["between $5 and $10", r"\$a\$", "$ a $", "`$a$`", "    $a$", "a $ b", "$$", "$a\n\nb$"]
)
def test_amounts_of_money_and_code_stay_text(text):
    """Dollars next to digits or spaces, escaped dollars and code are no formulas."""
    assert "<math" not in page(text)
    assert not formula_problems(text)


@pytest.mark.parametrize(
    "latex",
    [
        r"\foo x",
        r"{}",
        r"\frac{1",
        r"\frac{a}{b",
        r"\sqrt{k",
        r"\dot " * 60 + "x",
        r"{",
        r"x^",
        r"a & b",
        r"a \\ b",
        r"\begin{matrix}\end{matrix}",
        r"\underbrace{x}_{y}",
        r"\not=",
        r"\boxed{x}",
        r"\def\a{xx}\a",
        r"\newcommand{\a}{\b\b}\a",
        r"\left(" * 300,
        r"\sqrt" * 200,
        "{" * 400 + "x" + "}" * 400,
        "x^{" * 200 + "x" + "}" * 200,
        "x" * 5000,
    ],
)
def test_what_cannot_be_typeset_is_shown_as_typed(latex):
    """A formula that is not understood, nested too deeply or too long is shown with its dollars."""
    with pytest.raises(LatexError):
        read_latex(latex)
    for typed, kind in ((f"a ${latex}$", Paragraph), (f"$${latex}$$", Code)):
        (block,) = note_blocks(typed)
        assert isinstance(block, kind)
        assert len(formula_problems(typed)) == 1
    (span,) = [span for span in block_spans(f"a ${latex}$") if span.style == "code"]
    assert span.text.replace(" ", "") == f"${latex}$".replace(" ", "")


def block_spans(text):
    """Return the spans of notes that are one paragraph."""
    (block,) = note_blocks(text)
    assert isinstance(block, Paragraph)
    return block.text


@pytest.mark.parametrize(
    "latex",
    [
        r"\href{javascript:alert(1)}{x}",
        r"\style{background:url(//evil.example)}{x}",
        r"\class{evil}{x}",
        r"\color{red;background:url(//evil.example)}x",
        r"\text{<script>alert(1)</script>}",
        r"\text{</math><img src=x onerror=alert(1)>}",
        r"\text{&lt;script&gt;}",
        r"\unicode{x3c}script>",
        r"<img src=x onerror=alert(1)>",
        r"x \text{#read(\"/etc/passwd\")}",
        r"\input{/etc/passwd}",
        r"\text{a\u0000b}",
        "\\text{\x07\ud800}",
        r"\unicode{x0} \unicode{xd800} \unicode{x110000}",
    ],
)
def test_hostile_latex_stays_text(latex):
    """No tag, attribute, address or command in LaTeX takes effect in the page or the PDF."""
    for typed in (f"a ${latex}$", f"$${latex}$$"):
        document = document_of(note_blocks(typed))
        html = page(typed)
        tags = re.findall(r"<[^>]*>", re.sub(r'alttext="[^"<>]*"', "", html))
        assert not any(re.search("script|img|href|evil", tag) for tag in tags), tags
        assert render_html(document)
        assert render_pdf(document).startswith(b"%PDF")


_TOKENS = st.sampled_from(
    [
        *"a 1 . , ' & + - = < > / | ( ) [ ] { } ^ _ ~ % # \" \\ \\\\ $ α √ □".split(),
        *r"\frac \sqrt \sqrt[3] \left( \right) \left. \right| \dot \ddot \hat \vec \bar".split(),
        *r"\sum \int \lim \sin \text \mathrm \mathbf \mathcal \omega \infty \to \le".split(),
        *r"\begin{matrix} \end{matrix} \begin{aligned} \end{aligned} \begin{cases}".split(),
        *r"\underset \overset \stackrel \binom \quad \, \! \limits \prime \pmod \substack".split(),
    ]
)


@settings(max_examples=300, deadline=None)
@given(st.lists(_TOKENS, max_size=25).map(" ".join))
def test_any_latex_is_read_or_refused(latex):
    """Any LaTeX becomes mathematics without foreign tags and characters, or is refused."""
    for display in (False, True):
        try:
            math = read_latex(latex, display=display)
        except LatexError:
            continue
        assert isinstance(math, Math)
        names = set(re.findall(r"<\s*/?\s*([a-zA-Z][\w-]*)", to_mathml(math)))
        ours = (
            "math mrow mi mn mo mtext mfrac msub msup msubsup mover munder munderover msqrt mroot"
        )
        assert names <= {*ours.split(), "mtable", "mtr", "mtd"}


@settings(max_examples=40, deadline=None)
@given(st.lists(_TOKENS, max_size=15).map(" ".join))
def test_any_latex_gives_a_pdf(latex):
    """Whatever a formula contains, the PDF is made."""
    blocks = note_blocks(f"a ${latex}$ b\n\n$$\n{latex}\n$$")

    assert render_pdf(document_of(blocks)).startswith(b"%PDF")
