"""Sections of the benchmarks' page can be made again one by one, and quick runs work."""

import sys
from importlib import import_module

import pytest

from benchmarks import __main__ as command
from benchmarks import page
from benchmarks.page import Table, section, write_page

CHEAP = ("feedback", "time_stages")


class _Module:
    TITLE, WORDS, TOOLS = "Speed", "What is compared.", ("numpy", "no-such-tool")


def _section(name: str, cell: str) -> str:
    table = Table(title="Times", head=["what", "s"], rows=[["ours", cell]])
    return section(name, _Module, [table], seconds=1.0, figures=None)  # type: ignore[arg-type]


def test_making_one_section_again_keeps_the_others(tmp_path):
    """A section that is made again replaces only itself, and sections keep the list's order."""
    file, order = tmp_path / "README.md", ("first", "second")
    file.write_text("# Mine\n\nWritten by hand.\n", encoding="utf-8")

    write_page(file, {"second": _section("second", "2.0")}, order=order)
    write_page(file, {"first": _section("first", "1.0")}, order=order)
    write_page(file, {"second": _section("second", "3.0")}, order=order)

    text = file.read_text(encoding="utf-8")
    assert text.startswith("# Mine\n\nWritten by hand.\n")
    assert text.index("| ours | 1.0 |") < text.index("| ours | 3.0 |")
    assert "2.0 |" not in text
    assert text.count("## Speed") == 2


def test_rows_may_be_in_a_file_beside_the_figure(tmp_path):
    """With a folder, the page links to a CSV file of the rows; without one it has the table."""
    table = Table(
        title="Times",
        head=["what", "s"],
        rows=[["ours, new", "1.0"]],
        better="Theirs.",
        in_file=True,
    )

    text = section("first", _Module, [table], seconds=1.0, figures=tmp_path)  # type: ignore[arg-type]
    printed = section("first", _Module, [table], seconds=1.0, figures=None)  # type: ignore[arg-type]

    assert (tmp_path / "first-1.csv").read_text(encoding="utf-8") == 'what,s\n"ours, new",1.0\n'
    assert "[first-1.csv](figures/first-1.csv)" in text
    assert "| ours, new |" not in text
    assert printed.index("Theirs.") < printed.index("| ours, new | 1.0 |")


@pytest.mark.parametrize("name", CHEAP)
def test_quick_runs_do_not_change_the_page(name, monkeypatch, capsys):
    """`--quick` prints the tables and does not change the page."""
    page = command.page_of(name)
    before = page.read_bytes()
    monkeypatch.setattr(sys, "argv", ["benchmarks", name, "--quick"])

    command.main()

    assert f"<!-- {name} -->" in capsys.readouterr().out
    assert page.read_bytes() == before


@pytest.mark.parametrize("name", command.BENCHMARKS)
def test_a_stored_section_has_the_words_of_its_module(name):
    """Each section of the page has the title, question and tools of its benchmark's module."""
    module = import_module(f"benchmarks.{name}")

    text = command.page_of(name).read_text(encoding="utf-8")

    stored = text.split(f"<!-- {name} -->")[1].split(f"<!-- end of {name} -->")[0]
    assert stored.strip().startswith(f"## {module.TITLE}\n\n{page.wrapped(module.WORDS)}\n")
    assert all(f"{tool} " in stored for tool in module.TOOLS)
