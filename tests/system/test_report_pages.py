"""Reports as a reader sees them: in a real browser, on a phone, in dark mode, on paper."""

import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import NamedTuple
from unicodedata import normalize

import html5lib
import pytest

from pipeline.plant.catalogue import CATALOGUE
from pipeline.report.effects import render_effects
from pipeline.report.files import write_files
from pipeline.report.gap_report import make_gap_files
from pipeline.report.lab_report import make_draft
from pipeline.report.make_report import write_draft
from pipeline.report.solution.write import render_solution
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.accessibility import violations
from tests.helpers.examples import analysed
from tests.helpers.gaps import make_gap, two_cart_analysis
from tests.helpers.grades import write_class
from tests.helpers.ucsd import write_one_cart_submission, write_two_cart_submission
from tests.helpers.waiting import PATIENCE

LONG = [pytest.mark.slow, pytest.mark.sample]
CASES = (
    "three", "gap", "solution", "effects", "class", "feedback",
    *(pytest.param(case, marks=LONG) for case in ("real-one", "real-two")),
)  # fmt: skip
# One effect for each kind of figure.
PICTURED = tuple({effect.axis: effect for effect in reversed(CATALOGUE)}.values())
LARGEST = 3_000_000  # largest size of a page, in bytes
WIDE, LAPTOP, PHONE = (1280, 900), (1100, 800), (390, 844)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder with the report of a case, made on first use."""
    made: dict[str, Path] = {}

    def of(case: str, request) -> Path:
        if case not in made:
            out = tmp_path_factory.mktemp(case)
            if case == "gap":
                gap = make_gap(keys=("coulomb_friction", "input_delay", "cubic_spring"))
                write_files(make_gap_files(gap, two_cart_analysis()), out, name="gap")
            elif case in ("class", "feedback"):
                out = write_class(out)
                out = out / "feedback" / "team-02" if case == "feedback" else out
            elif case == "effects":
                render_effects(PICTURED, out)
            elif case == "solution":
                render_solution(analysed("two-cart"), out)
            else:
                write_draft(make_draft(_analysis(case, out, request)).files, out)
            made[case] = out
        return made[case]

    return of


def _analysis(case: str, out: Path, request) -> Analysis:
    if not case.startswith("real"):
        return analysed(f"{case}-cart")
    data = request.getfixturevalue("real_data")
    if case == "real-one":
        return analyse(load_submission(write_one_cart_submission(out / "data", data)))
    return analyse(load_submission(write_two_cart_submission(out / "data", data, steps=(1, 2, 3))))


@pytest.fixture(params=CASES)
def made(request, folder) -> Path:
    """Return the folder of each case's report in turn."""
    return folder(request.param, request)


@pytest.fixture
def three(request, folder) -> Path:
    """Return the folder of the report on the shipped three-cart example."""
    return folder("three", request)


def page_of(made: Path) -> Path:
    (page,) = made.glob("*.html")
    return page


@pytest.fixture(scope="module")
def window(browser):
    """Yield a browser window for most pages, since opening a new one takes a second."""
    context = browser.new_context()
    yield context.new_page()
    context.close()


@pytest.fixture
def show(browser, window):
    """Open a page, in a new window if options are given; script errors fail the test."""
    pages, errors = [], []

    def on_error(error) -> None:
        errors.append(str(error))

    def on_line(line) -> None:
        if line.type == "error":
            errors.append(line.text)

    def opened(path: Path, *, size=WIDE, **options):
        page = browser.new_context(**options).new_page() if options else window
        pages.append(page)
        page.set_default_timeout(1e3 * PATIENCE)
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.emulate_media(color_scheme="light", reduced_motion="reduce")
        page.on("pageerror", on_error)
        page.on("console", on_line)
        page.goto(path.as_uri())
        return page

    yield opened
    for page in pages:
        page.remove_listener("pageerror", on_error)
        page.remove_listener("console", on_line)
        if page is not window:
            page.context.close()
    assert errors == []


# ------------------------------------------------------------------------ as files


@pytest.mark.slow
@pytest.mark.sample
def test_the_page_is_valid_html(made):
    """A strict parser finds no fault in the HTML, every id is unique, and the file is small."""
    html = page_of(made).read_text(encoding="utf-8")

    html5lib.HTMLParser(strict=True).parse(html)

    ids = Counter(re.findall(r'\sid="([^"]*)"', html))
    assert [id_ for id_, n in ids.items() if n > 1] == []
    assert len(html.encode()) < LARGEST


# The box of a word includes ascent and descent of its font, so the boxes of neighbouring lines may
# overlap a little. A word on top of another one overlaps by more than half.
_MOST_OVERLAP = 0.25
_WORD = re.compile(r'<word xMin="(.*?)" yMin="(.*?)" xMax="(.*?)" yMax="(.*?)">(.*?)</word>')


@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="no pdftotext: poppler-utils")
def test_no_word_of_the_pdf_is_cut_or_covered(made):
    """In the PDF no word is cut off by the edge of its page, and no word covers another."""
    pdf = next(made.glob("*.pdf"), None)
    if pdf is None:
        pytest.skip("this page has no PDF")
    boxes = subprocess.run(
        ["pdftotext", "-bbox", pdf, "-"],
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=True,
    ).stdout
    pages = re.findall(r'<page width="(.*?)" height="(.*?)">(.*?)</page>', boxes, re.DOTALL)
    assert len(pages) >= 4
    for width, height, body in pages:
        words = [Box._make([*map(float, m.groups()[:4]), m[5]]) for m in _WORD.finditer(body)]
        page = Box(0.0, 0.0, float(width), float(height), "")
        assert [word for word in words if not word.lies_in(page)] == []
        assert covered(words) == []


class Box(NamedTuple):
    """A text and its place."""

    left: float
    top: float
    right: float
    bottom: float
    text: str

    def lies_in(self, other: "Box") -> bool:
        """Return whether this box lies wholly inside the other box."""
        across = other.left <= self.left and self.right <= other.right
        return across and other.top <= self.top and self.bottom <= other.bottom

    @property
    def area(self) -> float:
        """Return width times height."""
        return (self.right - self.left) * (self.bottom - self.top)


def covered(boxes: list[Box]) -> list[tuple[str, str]]:
    """Return the pairs of texts of which one covers the other."""
    pairs = []
    boxes = sorted(boxes, key=lambda box: box.top)
    for i, a in enumerate(boxes):
        for b in boxes[i + 1 :]:
            if b.top >= a.bottom:
                break
            across = min(a.right, b.right) - max(a.left, b.left)
            down = min(a.bottom, b.bottom) - b.top
            if across > 0 and across * down > _MOST_OVERLAP * min(a.area, b.area) > 0:
                pairs.append((a.text, b.text))
    return pairs


# ------------------------------------------------------------------- in the browser


# The texts of a page: each run of text outside formulas and drawings, each formula as a whole, and
# each text of a drawing. Each comes with its box, and with the box that may cut it off.
BOXES = """() => {
  const found = [];
  const add = (rect, text, owner) => {
    const scroller = owner.closest('.wide, nav ul, pre');
    found.push([rect.left, rect.top, rect.right, rect.bottom, text, Boolean(scroller)]);
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const owner = node.parentElement;
    if (!node.textContent.trim() || owner.closest('math, svg, script, .skip')) continue;
    if (!owner.checkVisibility()) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const rect of range.getClientRects()) add(rect, node.textContent.trim(), owner);
  }
  for (const math of document.querySelectorAll('main math'))
    if (math.checkVisibility()) add(math.getBoundingClientRect(), math.textContent, math);
  return found;
}"""

# The tables that are wider than their place, and where the text of the page begins.
CUT = """() => Array.from(document.querySelectorAll('.wide:has(table)')).filter(
    (place) => place.scrollWidth > place.clientWidth + 1).map((place) => place.ariaLabel)"""
TOP = "document.querySelector('main').getBoundingClientRect().top"


@pytest.mark.slow
@pytest.mark.sample
def test_pages_are_accessible_on_every_screen(made, show):
    """On every screen the checker axe finds no serious barrier.

    Only parts that scroll are wider than the page, no text covers another, and figures contain
    their texts. On a phone no table scrolls, and the head takes at most a fifth of the screen. On a
    laptop letters in figures are at least ten pixels high.
    """
    page = show(page_of(made))
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    assert [v for v in violations(page) if v.impact in ("serious", "critical")] == []
    for width, height in (WIDE, PHONE):
        page.set_viewport_size({"width": width, "height": height})

        assert page.evaluate("document.documentElement.scrollWidth") <= width
        boxes = [(Box(*box), scrolled) for *box, scrolled in page.evaluate(BOXES)]
        assert len(boxes) > 100
        # Half a pixel is allowed, since boxes of letters are rounded outwards.
        fixed = [box for box, scrolled in boxes if not scrolled]
        assert [box for box in fixed if box.left < -0.5 or box.right > width + 0.5] == []
        assert covered([box for box, _ in boxes]) == []
        if width == PHONE[0]:
            assert page.evaluate(CUT) == []
            assert page.evaluate(TOP) <= height / 5
        for edge, texts in page.evaluate(DRAWN):
            drawn = [Box(*text) for text in texts]
            assert [text for text in drawn if not text.lies_in(Box._make([*edge, ""]))] == []
            assert covered(drawn) == []
    page.set_viewport_size({"width": LAPTOP[0], "height": LAPTOP[1]})
    assert page.evaluate(SMALLEST) >= 10


DRAWN = """() => [...document.querySelectorAll('figure svg')].map((svg) => {
  const box = svg.getBoundingClientRect();
  const texts = [...svg.querySelectorAll('text')].filter((t) => t.checkVisibility());
  return [[box.left, box.top, box.right, box.bottom], texts.map((t) => {
    const r = t.getBoundingClientRect();
    return [r.left, r.top, r.right, r.bottom, t.textContent];
  })];
})"""
SMALLEST = """() => Math.min(...Array.from(document.querySelectorAll('figure svg text'), (text) =>
    text.ownerSVGElement.getScreenCTM().a * parseFloat(getComputedStyle(text).fontSize)))"""


def test_a_class_is_searched_and_sorted(folder, request, show):
    """Words filter the table of a class, and clicks on headings sort it up and down."""
    page = show(page_of(folder("class", request)))
    table = page.locator("table.finder")
    rows = table.locator("tbody tr:visible")

    def column(n: int) -> list[str]:
        return [text.strip() for text in rows.locator(f"td:nth-child({n})").all_inner_texts()]

    assert rows.count() == 16
    page.get_by_label("Search").fill("UNAL s12")
    assert column(1) == ["Ünal 学生 & co"]
    assert page.locator(".find output").inner_text() == "1 of 16"
    page.get_by_label("Search").fill("hz_for_rad_s")
    assert rows.count() == 5
    page.get_by_label("Search").fill("")
    page.get_by_role("button", name="Points").last.click()
    points = [float(text) for text in column(3)]
    assert points == sorted(points)
    page.get_by_role("button", name="Points").last.click()
    assert [float(text) for text in column(3)] == points[::-1]
    heading = table.locator("th", has_text="Points")
    assert heading.get_attribute("aria-sort") == "descending"

    rows.get_by_role("link", name="Ünal").click()
    assert page.locator("h1").inner_text() == "Ünal 学生 & co"


def test_numbers_can_be_copied(three, show):
    """A copied table has tabs and plain numbers, with value and error in separate columns."""
    page = show(page_of(three), permissions=["clipboard-read", "clipboard-write"])

    page.get_by_role("button", name="Copy Table 2").click()
    table = page.evaluate("navigator.clipboard.readText()")
    page.get_by_role("button", name="Copy these numbers").first.click()
    matrix = page.evaluate("navigator.clipboard.readText()")

    rows = [line.split("\t") for line in table.splitlines()]
    assert rows[0][:4] == ["Parameter", "Unit", "Initial estimate", "std"]
    assert len({len(row) for row in rows}) == 1
    K_1 = next(row for row in rows if row[0] == "K_1")
    assert float(K_1[2]) == pytest.approx(39.07, rel=0.01)
    assert 0 < float(K_1[3]) < 0.1
    assert re.fullmatch(r"A = \[[-\d.e ;]+\];", matrix)
    assert matrix.count(";") == 6


def test_a_phone_shows_the_numbers_in_two_columns(three, show):
    """The tiles of three carts fit a phone in two columns."""
    page = show(page_of(three), size=PHONE)
    tiles = page.locator("dl.tiles").first.locator(".tile")
    boxes = [tile.bounding_box() for tile in tiles.all()]
    assert len({round(box["x"]) for box in boxes}) == 2
    values = page.locator("dl.tiles").first.locator("dd.value")
    assert values.evaluate_all("all => all.every(one => one.scrollWidth <= one.clientWidth)")


def test_without_scripts_everything_can_be_read(three, show):
    """Without scripts all figures, numbers and folded parts can be read."""
    page = show(page_of(three), java_script_enabled=False)

    assert page.locator("figure svg").count() == page.locator("figure").count() > 5
    assert page.locator("button").count() == 0
    page.locator("#checks summary").click()
    assert page.locator("#checks table").first.is_visible()


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="no pdftotext: poppler-utils")
def test_printing_opens_folded_tables(three, show, tmp_path):
    """Printing opens the folded tables, and omits buttons that work only on a screen."""
    page = show(page_of(three))
    paper = tmp_path / "paper.pdf"
    page.pdf(path=paper, format="A4")

    read = subprocess.run(
        ["pdftotext", paper, "-"], capture_output=True, text=True, encoding="utf-8", check=True
    )
    text = " ".join(normalize("NFKC", read.stdout).split())
    assert "converged" in text
    assert "Copy" not in text
    assert "Figure 3." in text
