"""The summary that `cartlab report` prints fits a terminal."""

import shutil

import pytest

from pipeline.cli.common import brief_lines
from pipeline.resources import EXAMPLES
from tests.helpers.commandline import cartlab_here

ITEMS = [f"- Item {i} is odd. {'It has details. ' * 12}" for i in range(9)]
LONG = "\n".join(["A model was found. " * 3, *ITEMS, "Next:", *ITEMS])


@pytest.mark.parametrize("width", [40, 80, 200])
@pytest.mark.parametrize("items", [0, 1, 4, 9])
def test_a_summary_never_has_more_lines_than_allowed(width, items):
    """Each line fits the width, and the first and the last item of each list are shown."""
    text = "\n".join(["A model was found. " * 3, *ITEMS[:items], "Next:", *ITEMS[:items]])
    lines = brief_lines(text, width=width, most=12, more="the page")
    assert len(lines) <= 12
    assert max(map(len, lines)) <= width
    if items:
        assert sum(line.startswith(f"- Item {items - 1} ") for line in lines) == 2


def test_a_short_summary_is_shown_whole():
    """A summary that fits is only wrapped, and no name or number is broken."""
    text = "It has K_1 = 1.0 → 2.0; K_2 = 3.0 → 4.0.\n- See data/a-very-long-name-of-a-file.csv."
    lines = brief_lines(text, width=20, most=12, more="the page")
    assert " ".join(" ".join(lines).split()) == " ".join(text.split())
    assert any("K_2 = 3.0 → 4.0." in line for line in lines)
    assert any("data/a-very-long-name-of-a-file.csv." in line for line in lines)


def test_what_is_left_out_is_counted():
    """The last line says how many items are left out, and where they are."""
    lines = brief_lines(LONG, width=80, most=12, more="the page")
    left = 18 - sum(line.startswith("- Item") for line in lines)
    assert lines[-1].startswith(f"- {left} more: ")
    assert lines[-1].endswith("the page")


@pytest.mark.slow
@pytest.mark.sample
def test_many_files_that_cannot_be_read_do_not_fill_the_terminal(tmp_path):
    """The terminal shows some of the files; all are on the page."""
    folder = tmp_path / "one-cart"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    with (folder / "submission.toml").open("a", encoding="utf-8") as toml:
        for i in range(30):
            (folder / "data" / f"odd-{i}.csv").write_text("time,input,x1\n0,0,0\n1,?,0\n")
            toml.write(f'\n[[experiments]]\nid = "odd-{i}"\nkind = "step"\n')
            toml.write(f'file = "data/odd-{i}.csv"\n')
    done = cartlab_here("report", folder, "--no-pdf")
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if not line.endswith(" s")]
    assert len(lines) <= 20
    page = (folder / "report" / "report.html").read_text(encoding="utf-8")
    assert all(f"odd-{i}:" in page or f"odd-{i}<" in page for i in range(30))
