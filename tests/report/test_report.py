"""A report's two files are complete, safe and self-contained, with the same bytes each time."""

import base64
import hashlib
import io
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pypdf
import pytest

from pipeline.identify.recording_checks import check_files, check_left_out
from pipeline.plant.chain import Chain
from pipeline.report.builder import Page as Shown  # what sections are made of
from pipeline.report.changes import DraftChanges
from pipeline.report.document import (
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    cell,
    make_table,
)
from pipeline.report.html import render_blocks, render_html
from pipeline.report.lab_report import build_document, make_draft
from pipeline.report.make_report import Files, write_draft
from pipeline.report.pdf import missing_characters, render_pdf
from pipeline.report.sections.measurements import decay_blocks
from pipeline.report.sections.questions import unanswered
from pipeline.report.sections.summary import summary, terminal_summary
from pipeline.results import Analysis, Check, Estimate, Finding, ParameterRow, Skipped, Stage
from pipeline.setup import Setup, Units
from pipeline.words.text import plain, spans
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.pages import HOSTILE, Page, pictures, sections, tiles


def render(analysis: Analysis, out: Path, *, pdf: bool = True) -> tuple[Page, str]:
    """Render a report; return the parsed page and the PDF's text."""
    render_report(analysis, out, files=Files(pdf=pdf))
    return read(out)


def render_report(analysis: Analysis, out: Path, **options: Any) -> None:
    """Make a report and write it into a folder."""
    write_draft(make_draft(analysis, **options).files, out)


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[int, Path]:
    """Write reports for 1, 2 and 3 carts once for all tests."""
    made = {}
    for carts in (1, 2, 3):
        made[carts] = tmp_path_factory.mktemp(f"report-{carts}")
        render_report(make_analysis(carts), made[carts])
    return made


def read(folder: Path) -> tuple[Page, str]:
    """Return the parsed page and the PDF's text, which is empty if there is no PDF."""
    return parsed(folder), printed_text(folder) if (folder / "report.pdf").exists() else ""


def parsed(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


@cache
def printed_text(folder: Path) -> str:
    """Return the PDF's text; reading it takes half a second."""
    reader = pypdf.PdfReader(folder / "report.pdf")
    return "\n".join(p.extract_text() for p in reader.pages).replace("\u00a0", " ")


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_every_part_is_there(carts, folders):
    """Page and PDF have every part: summary, model, tables, figures, checks and notes."""
    page, pdf = read(folders[carts])

    parts = sections(build_document(make_analysis(carts)))
    assert [*parts] == [
        "summary", "model", "parameters", "frequency-response", "decays", "steps", "steady-state",
        "feedback", "hardware", "checks", "discussion", "warnings", "skipped", "provenance",
    ]  # fmt: skip
    for part in parts.values():
        assert part.title in page.text
        assert part.title in pdf
    names = {path.stem for path in (folders[carts] / "figures").iterdir()}
    expected = {f"{kind}-cart-{i}" for kind in ("bode", "decay") for i in range(1, carts + 1)}
    assert names == {*expected, "damping", "feedback", "hardware", "overview", "sine", "steps"}
    shown = [name for name in pictures(parts["frequency-response"].blocks) if name in expected]
    assert shown == [f"bode-cart-{i}" for i in range(carts, 0, -1)]  # last first, as in the paper
    assert "Émilie du Châtelet (s1025)" in page.text
    assert "Émilie du Châtelet (s1025)" in pdf


def test_figures_are_in_the_same_sections_in_print(folders):
    """In print, every figure and question is in the same section as on the page."""
    html = (folders[3] / "report.html").read_text(encoding="utf-8")
    pdf = printed_text(folders[3])
    marks = re.findall(r"<h2[^>]*>([^<]+)</h2>|<b>(Figure \d+)\.|<b>(Question\.)", html)

    at, places = 0, []
    for mark in marks:
        (text,) = filter(None, mark)
        places.append(text)
        at = pdf.index(text, at)
    assert len([place for place in places if place.startswith("Figure")]) > 8


def test_figures_that_follow_each_other_are_printed_in_pairs():
    """Two figures in a row of the same section share a line, so that six fit on a page."""
    svg = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 66"/>'
    row = tuple(
        Picture(number=n, name=f"p{n}", caption=spans("Two words"), alt="nothing", draw=lambda: svg)
        for n in range(6)
    )
    apart = tuple(part for one in row for part in (one, Paragraph(spans("A line."))))
    pages = [len(printed(Section("f", "Figures", blocks))) for blocks in (row, apart)]
    assert pages[0] == 1 < pages[1]


def printed(*sections: Section) -> list[str]:
    """Return the text of each page on which the sections are printed."""
    document = Document("A", "", (), sections, "the footer")
    return [page.extract_text() for page in pypdf.PdfReader(io.BytesIO(render_pdf(document))).pages]


@pytest.mark.parametrize("rows", [24, 30, 40])
def test_a_table_longer_than_a_page_breaks_and_stays_with_its_heading(rows):
    """A table longer than a page breaks, and its heading stays with its first rows."""
    body = tuple((cell(f"row-{i:02d}"), cell("Dry friction holds it. " * 24)) for i in range(rows))
    table = Table(1, spans("All checks."), (cell("Check"), cell("Found")), body, "ll")

    first, *others = printed(Section("c", "Consistency", (table,)))

    assert others
    assert "Consistency" in first
    assert "row-00" in first
    assert len(re.findall(r"row-\d\d", first + "".join(others))) == rows


@pytest.mark.slow
@pytest.mark.sample
def test_print_is_shorter_than_the_page(folders):
    """The page has every check, dwell and change of a draft; the PDF has a line a kind of check."""
    analysis = make_analysis(3)
    html = (folders[3] / "report.html").read_text(encoding="utf-8")
    pdf = printed_text(folders[3])
    for check in analysis.checks:
        assert f"<code>{check.id}</code>" in html
        assert check.kind in pdf
        assert (check.id in pdf) == (check.outcome == "fail" or check.id == check.kind)
    assert not any(sha in text for sha in analysis.files.values() for text in (html, pdf))
    document = build_document(analysis, changes=DraftChanges(numbers=(), failed={}))
    assert "changes" in sections(document)
    assert sections(document)["changes"].title not in "".join(printed(*document.sections))


@pytest.mark.parametrize(
    ("head", "row", "wide"),
    [
        (["Entry", "Expected"], ["A(2, 1)", "−174.5"], False),
        (["Change of the level"] * 3, ["12.34"] * 3, False),  # headings break between words
        (["Unit"] * 8, ["rad/s"] * 8, True),
        (["Check", "Found"], ["fit", "The residual is larger than the stated noise."], True),
        (["Name"], ["x" * 60], True),
    ],
)
def test_a_phone_shows_rows_of_wide_tables_as_lines(head, row, wide):
    """A phone shows a row as lines, each with its heading, if the columns do not fit."""
    table = make_table(1, "A table.", head, [row], "l" * len(head))

    html = str(render_blocks([table]))

    assert (' told"' in html) == wide
    assert html.count("data-head") == (len(head) if wide else 0)


def test_the_page_loads_nothing(folders):
    """The page loads nothing, and its security policy lets only its own script run."""
    html = (folders[2] / "report.html").read_text(encoding="utf-8")
    page = Page(html)

    (policy,) = (
        attrs["content"] or "" for tag, attrs in page.tags
        if tag == "meta" and attrs.get("http-equiv") == "Content-Security-Policy"
    )  # fmt: skip
    assert policy.startswith("default-src 'none'")
    assert not {tag for tag, _ in page.tags} & {"link", "iframe", "object", "img"}
    assert page.values("src") == []
    assert all(href.startswith("#") for href in page.values("href"))
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{known}';" in policy
    assert all(url.startswith(('"data:', "#")) for url in re.findall(r"url\(([^)]*)", html))
    assert not re.search(r"\son\w+=", html)


def test_the_page_is_accessible(folders):
    """Every section is linked, every figure has a description, and every formula is MathML."""
    page = parsed(folders[3])

    links = {href[1:] for href in page.values("href")}
    assert {attrs["id"] for tag, attrs in page.tags if tag == "section"} <= links
    assert links <= set(page.values("id"))
    drawings = [attrs for tag, attrs in page.tags if tag == "svg"]
    assert page.count("figure") == len(drawings) > 5
    assert all(svg.get("role") == "img" and svg.get("aria-label") for svg in drawings)
    assert page.count("title") == 1  # a further one would be a tooltip
    assert sum(attrs.get("display") == "block" for tag, attrs in page.tags if tag == "math") >= 6
    assert ("html", {"lang": "en"}) in page.tags


@pytest.mark.slow
@pytest.mark.sample
def test_a_report_without_a_title_uses_its_subject_once():
    """If a report has no title, its subject becomes the title and is not repeated."""
    analysis = make_analysis(2)
    named = build_document(analysis)
    bare = build_document(replace(analysis, title=" "))
    assert (named.title, named.subtitle) == (
        "The 2-cart system, bench 4", "Section 03 · Identification and control of 2 carts",
    )  # fmt: skip
    assert (bare.title, bare.subtitle) == ("Identification and control of 2 carts", "Section 03")
    nothing = build_document(replace(analysis, title="", section=""))
    assert nothing.subtitle == ""
    assert "kicker" not in render_html(nothing).split("<main", 1)[-1].split("<section", 1)[0]


def test_a_goal_met_on_a_poor_model_is_not_green():
    """The tile of a goal that the simulation meets is green only if the model explains the data."""
    analysis = make_analysis(1)
    assert analysis.fit
    poor = replace(analysis, fit=replace(analysis.fit, chi_square_per_dof=1e4))
    boards = [tiles(summary(Shown(one))) for one in (analysis, poor)]
    tones = [tile.tone for board in boards for tile in board if tile.url == "#feedback"]
    assert tones == ["good", ""]


def test_the_same_analysis_gives_the_same_bytes(folders, tmp_path):
    """The same analysis gives the same bytes of HTML, PDF and every figure."""
    render_report(make_analysis(2), tmp_path)
    first = sorted(folders[2].rglob("*.*"))
    assert len(first) > 8
    for path in first:
        again = tmp_path / path.relative_to(folders[2])
        assert path.read_bytes() == again.read_bytes(), path.name


@pytest.mark.parametrize(
    ("part", "files"),
    [("pdf.render_pdf", Files()), ("compare.compare_runs", Files(plots=True))],
)
def test_an_interrupted_report_leaves_the_earlier_one_whole(
    folders, tmp_path, monkeypatch, part, files
):
    """Ctrl-C while a report or its plots are made leaves the earlier report as it was."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    shutil.copytree(folders[1], tmp_path, dirs_exist_ok=True)
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))}
    monkeypatch.setattr(f"pipeline.report.{part}", interrupt)
    with pytest.raises(KeyboardInterrupt):
        render_report(make_analysis(2), tmp_path, files=files)
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))} == before


def test_the_pdf_is_archival_and_navigable(folders):
    """The PDF follows PDF/A-2a and PDF/UA-1 and has bookmarks, title, authors and page numbers."""
    reader = pypdf.PdfReader(folders[3] / "report.pdf")

    about, xmp = reader.metadata, reader.xmp_metadata
    assert about is not None
    assert about.title == make_analysis(3).title
    assert "Ada Lovelace" in str(about.author)
    titles = [item.title for item in reader.outline if not isinstance(item, list)]
    assert (titles[0], titles[-1]) == ("Summary", "Provenance")
    assert xmp is not None
    packet = xmp.stream.get_data().decode()
    for mark in ("pdfaid:part>2<", "pdfaid:conformance>A<", "pdfuaid:part>1<"):
        assert mark in packet
    assert f"1 of {len(reader.pages)}" in reader.pages[0].extract_text()
    entries = [reader.get_object(i + 1) for i in range(len(reader.xref[0]))]
    alts = [str(one["/Alt"]) for one in entries if isinstance(one, dict) and "/Alt" in one]
    pictures = build_document(make_analysis(3)).pictures()
    assert {picture.alt for picture in pictures} <= {alt.replace("\u00a0", " ") for alt in alts}


def test_hostile_text_stays_text(tmp_path):
    """Markup of typst, HTML, Jinja and Markdown in any field appears as plain text."""
    analysis = make_analysis(2)
    evil = replace(
        analysis,
        title=HOSTILE,
        section=HOSTILE,
        authors=((HOSTILE, HOSTILE), ("'\"><img src=x>", "")),
        bench=replace(analysis.bench, units=Units(position="<i>c$m", input="#V")),
        records=tuple(replace(r, id=HOSTILE) if r.id == "step-a" else r for r in analysis.records),
        step_gains=tuple(replace(g, experiment=HOSTILE, note=HOSTILE) for g in analysis.step_gains),
        warnings=(HOSTILE,),
        skipped=(Skipped(stage=Stage.SINE, run=HOSTILE, reason=HOSTILE),),
        files={HOSTILE: "0" * 64},
        discussion=HOSTILE + '\n\n#read("report.typ")\n\n<iframe src=x>',
    )
    page, pdf = render(evil, tmp_path)

    assert not {tag for tag, _ in page.tags} & {"img", "iframe", "i"}
    assert page.count("script") == 1
    assert page.text.count("<script>alert(1)</script>") > 5
    assert "49" not in re.findall(r"\{\{.*?\}\}|49", page.text)[:1]
    flat = re.sub(r"\s", "", pdf)
    assert re.sub(r"\s", "", HOSTILE.partition(" \\")[0]) in flat
    assert '#read("report.typ")' in flat


def test_characters_that_the_fonts_lack_give_a_warning(tmp_path):
    """If the PDF's fonts lack characters of a name, the PDF shows boxes, and a warning says so."""
    said = []
    analysis = replace(make_analysis(1), authors=(("s1", "李雷 😀"), ("s2", "Žofie Ελένη Иван")))
    render_report(analysis, tmp_path, progress=said.append)
    page, text = read(tmp_path)

    assert "李雷 😀" in page.text
    assert "□□" in text
    for shown in (page.text, text):
        assert "Žofie Ελένη Иван" in shown
        assert "fonts lack" in shown
    assert any("李" in line for line in said)
    assert missing_characters("Žofie Ελένη Иван, naïve → ± ²") == ""


def test_control_characters_do_no_harm(tmp_path):
    """Ids and titles with characters that XML and PDF forbid still give both files."""
    analysis, odd = make_analysis(1), "a\x00b\x0bc\ud800d\ufffee"
    records = tuple(replace(r, id=f"{r.id}{odd}") for r in analysis.records)
    decays = tuple(replace(d, experiment=f"{d.experiment}{odd}") for d in analysis.log_decrements)
    page, pdf = render(
        replace(analysis, title=odd, records=records, log_decrements=decays), tmp_path
    )
    assert "a�b�c�d�e" in page.text
    assert pdf


NOTHING: dict[str, Any] = dict.fromkeys(
    ("records", "log_decrements", "step_gains", "sine_points", "frequency_responses", "rows",
     "checks", "hardware", "warnings"), (),
) | {"fit": None, "feedback": None, "discussion": None, "files": {}}  # fmt: skip
REASON = Skipped(stage=Stage.BODE_FIT, reason="no dwells: needs 8 points, found 0")


def bare(analysis: Analysis, **parts) -> Analysis:
    """Return an analysis without results, except for the given parts."""
    return replace(analysis, **{**NOTHING, "skipped": (REASON,), **parts})


@pytest.mark.parametrize("skipped", [(), (REASON,)])
def test_without_results_the_reasons_are_given(skipped, tmp_path):
    """Without results, a report gives the reasons, if there are any, and has no dead links."""
    analysis = bare(make_analysis(2), skipped=skipped)
    page, pdf = render(analysis, tmp_path)
    for text in (page.text, pdf):
        assert (REASON.reason in text) == bool(skipped)
    assert not {"decays", "steps", "parameters"} & sections(build_document(analysis)).keys()
    assert list((tmp_path / "figures").iterdir()) == []
    assert {href[1:] for href in page.values("href")} <= set(page.values("id"))


@pytest.mark.parametrize("part", sorted(NOTHING.keys() - {"warnings", "files"}))
def test_any_part_may_be_missing(part):
    """If one part of the analysis is missing, the page is made without it and shows no None."""
    analysis = replace(make_analysis(1, repeats=1), **{part: NOTHING[part]})
    page = Page(render_html(build_document(analysis)))
    assert {"summary", "provenance"} <= set(page.values("id"))
    text = page.text.replace("norm(feedback(1, L), inf)", "")  # MATLAB's name of a norm
    assert not re.search(r"\b(None|nan|inf)\b", text)


@pytest.mark.parametrize(
    "part", ["log_decrements", "step_gains", "sine_points", "frequency_responses", "hardware"]
)
def test_results_of_a_single_stage_give_a_report(part, tmp_path):
    """The results of a single stage, with their recordings, give a page and a PDF."""
    analysis = make_analysis(1)
    kept = bare(analysis, records=analysis.records, **{part: getattr(analysis, part)})
    page, pdf = render(kept, tmp_path)
    assert "Figure 1" in page.text
    assert "Figure 1" in pdf


def test_a_table_of_ratios_has_no_phase():
    """If a response comes from a table of ratios, its Bode figure has no phase and says why."""
    analysis = make_analysis(1)
    (response,) = analysis.frequency_responses
    table = replace(response, phase=None, phase_std=None, source="table")
    document = build_document(replace(analysis, frequency_responses=(table,)))
    picture = pictures(sections(document)["frequency-response"].blocks)["bode-cart-1"]
    assert "no phase" in Page(render_html(document)).text
    assert "phase [°]" not in picture.svg
    assert "residual [%]" in picture.svg


CHAINS = {
    "rigid": Chain(m=np.array([2e-4]), c=np.array([5e-4]), k=np.zeros(2)),
    "overdamped": Chain(m=np.array([2e-4]), c=np.array([1e-2]), k=np.array([0.03, 0.0])),
    "loose": Chain(m=np.array([2e-4, 2e-4]), c=np.array([5e-4, 5e-4]), k=np.array([0, 0.1, 0])),
    "four": Chain(
        m=np.array([3e-4, 2.5e-4, 2e-4, 1.8e-4]),
        c=np.array([1.5e-3, 4e-4, 3e-4, 3e-4]),
        k=np.array([0.05, 0.12, 0.07, 0.06, 0.06]),
    ),
    "negative": Chain(
        m=np.array([2e-4, 2e-4]), c=np.array([5e-4, 0]), k=np.array([-0.01, 0.1, 0.1])
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHAINS)
def test_unusual_chains_are_shown(name, tmp_path):
    """Unusual chains have a model on the page, for example a rigid body or a negative spring."""
    chain = CHAINS[name]
    analysis = make_analysis(min(chain.n, 3))
    assert analysis.fit is not None
    names = tuple(f"{letter}_{i}" for letter in "mc" for i in range(1, chain.n + 1))
    mass = Estimate(value=chain.m[0], std=1e-6, source="time_fit")
    fit = replace(
        analysis.fit,
        method="time_fit",
        chain=chain,
        names=names,
        covariance=np.diag(np.full(len(names), 1e-12)),
        parameters={"mass": mass},
        staged={},
    )
    row = ParameterRow(
        name="mass", unit="V s^2/cm", initial=None, final=mass,
        change_percent=None, change_sigmas=None, consistent=None,
    )  # fmt: skip
    bench = Setup(springs=tuple(bool(k != 0) for k in chain.k))
    page, pdf = render(bare(analysis, bench=bench, fit=fit, rows=(row,)), tmp_path)
    assert {"model", "parameters"} <= set(page.values("id"))
    assert not re.search(r"\b(None|nan)\b", page.text + pdf)


def test_the_summary_reports_a_poor_result():
    """If results disagree or the fit failed, the summary says so and advises what to do."""
    analysis = make_analysis(2)
    assert analysis.fit is not None
    fit = replace(analysis.fit, converged=False, message="k_1 at its bound", chi_square_per_dof=9.0)
    failed = tuple(
        replace(row, final=None, consistent=None, change_sigmas=None) for row in analysis.rows
    )
    text = terminal_summary(replace(analysis, fit=fit, rows=failed, feedback=None))
    assert fit.message in text
    assert "K_1" not in text.partition("\n")[0]

    rows = tuple(
        replace(row, consistent=False, change_percent=23.4) if row.name == "K_1" else row
        for row in analysis.rows
    )
    hardware = tuple(replace(check, nrmse=0.4) for check in analysis.hardware)
    fit = replace(analysis.fit, chi_square_per_dof=9.0)
    text = terminal_summary(replace(analysis, fit=fit, rows=rows, hardware=hardware))
    poor = replace(analysis, fit=fit)
    # An error is shown only if the fit's residual is only noise.
    boards = [[plain(tile.note) for tile in tiles(summary(Shown(a)))] for a in (analysis, poor)]
    assert [any("±" in note for note in board) for board in boards] == [True, False]
    (unsettled,) = {point.experiment for point in analysis.sine_points if not point.settled}
    for said in ("K_1 (+23.4 %)", unsettled, *(check.id for check in analysis.failed_checks)):
        assert said in text


def test_the_ring_down_of_a_step_is_not_called_a_release():
    """If there is no decay, the figure shows the ring-down of a step and says so."""
    analysis = make_analysis(1)
    ringing = {decay.experiment for decay in analysis.log_decrements}
    records = tuple(replace(r, kind="step") if r.id in ringing else r for r in analysis.records)

    for one in (analysis, replace(analysis, records=records)):
        captions = [plain(p.caption) for p in pictures(decay_blocks(Shown(one))).values()]
        assert any("released" in caption for caption in captions) == (one is analysis)


def test_a_recording_that_was_left_out_is_not_listed_as_a_source():
    """A recording that was left out is not a source of the model; a missing file is asked for."""
    analysis = make_analysis(2)
    dwells = [record.id for record in analysis.records if record.kind == "sine"]
    left_out = Finding(code="stray", run=dwells[0], details={"percent": 30}, excludes="wrong")
    assert analysis.fit is not None
    unreadable = {"step-9": "there is no file"}
    checks = check_left_out([left_out], records=analysis.records) + check_files(unreadable)
    spoilt = replace(
        analysis,
        fit=replace(analysis.fit, experiments=tuple(dwells[1:])),
        left_out=(left_out,),
        unreadable=unreadable,
        checks=tuple(checks),
    )
    text = terminal_summary(spoilt)
    assert f"{len(dwells)} sine dwells" in terminal_summary(analysis)
    assert f"{len(dwells) - 1} sine dwells" in text
    assert f"{dwells[0]} is left out: {left_out.reason}" in text
    advice = text.partition("What to do next.")[2]
    assert all((check.about or check.id) in advice for check in spoilt.failed_checks)


def test_an_unreadable_file_asks_for_no_new_experiment():
    """If a file cannot be read, the summary asks for this file and not for a new experiment."""
    unread = Skipped(stage=Stage.READING, run="step-1", reason="empty")
    missing = Skipped(stage=Stage.HARDWARE_CHECK, reason="none", missing="a closed-loop run")
    analysis = replace(make_analysis(1, repeats=1), unreadable={"step-1": "empty"})
    asked = [
        missing.missing in terminal_summary(replace(analysis, skipped=skipped))
        for skipped in ((unread,), (unread, missing))
    ]
    assert asked == [False, True]


def test_an_id_of_a_skipped_run_keeps_its_underscores():
    """An id with underscores is shown unchanged in the lists of skipped stages."""
    decay = Skipped(stage=Stage.LOG_DECREMENT, run="my_decay_1", cart=1, reason="too short")
    analysis = replace(make_analysis(1), skipped=(decay,))
    assert "my_decay_1" in terminal_summary(analysis)
    assert Page(render_html(build_document(analysis))).text.count("my_decay_1, cart 1") >= 2


def test_the_summary_of_a_good_result_is_short():
    """If there is no problem, the summary says so in a few lines."""
    analysis = make_analysis(1, repeats=1)
    rows = tuple(replace(row, consistent=True) for row in analysis.rows)
    checks = tuple(check for check in analysis.checks if check.outcome == "pass")
    points = tuple(replace(point, settled=True) for point in analysis.sine_points)
    good = replace(analysis, rows=rows, checks=checks, sine_points=points, skipped=(), warnings=())
    feedback = good.feedback
    assert feedback is not None
    asked = unanswered(good)
    assert asked
    unread = terminal_summary(good)
    answered = "".join(f"## {question.id}\n\nFriction.\n\n" for question in asked)
    good = replace(good, discussion=answered)
    missed = replace(feedback, reachable=False, message="settling in 1 ms cannot be met")
    worse = (good, replace(good, warnings=("odd",)), replace(good, feedback=missed))
    texts = [terminal_summary(one) for one in worse]
    assert len(texts[0].splitlines()) == min(len(text.splitlines()) for text in texts)
    assert ["Nothing to fix" in text for text in (unread, *texts)] == [False, True, True, False]


def test_damping_at_one_amplitude_is_not_drawn():
    """Damping is drawn against amplitude only if a decay has at least two amplitudes."""
    analysis = make_analysis(1)
    one = tuple(
        replace(decay, zeta_at_amplitude=decay.zeta_at_amplitude[:, :1])
        for decay in analysis.log_decrements
    )
    alone = replace(analysis, log_decrements=one)
    drawn = [[block.kind for block in decay_blocks(Shown(a))] for a in (analysis, alone)]
    assert drawn[0].count("picture") == drawn[1].count("picture") + 1


def test_estimates_too_uncertain_to_compare_are_both_given():
    """If the estimates are too uncertain to compare, the summary gives both values."""
    analysis = make_analysis(1)
    (first, *others) = analysis.rows
    assert first.final is not None
    final = replace(first.final, value=35.0, std=3.5)
    initial = Estimate(value=29.0, std=0.1, source="step")
    open_ = replace(first, initial=initial, final=final, change_sigmas=1.7, consistent=None)
    both = "(initial 29.00 ± 0.10, final 35.0 ± 3.5)"
    assert both in terminal_summary(replace(analysis, rows=(open_, *others)))
    assert both not in terminal_summary(analysis)


def test_a_wrong_sign_is_named_first():
    """A sign that the data contradict is named first, since it may cause other failures."""
    analysis = make_analysis(1, repeats=1)
    wrong = Check(
        kind="input", part="sign", outcome="fail", value=3.0, limit=0.0, message="set it to 1"
    )
    off = tuple(replace(row, consistent=False) for row in analysis.rows)
    text = terminal_summary(replace(analysis, checks=(wrong, *analysis.checks), rows=off))
    findings, _, advice = text.partition("What to do next.")
    first = next(line for line in findings.splitlines() if line.startswith("- "))
    assert wrong.message in first
    assert advice.strip().splitlines()[0].endswith(wrong.id)
