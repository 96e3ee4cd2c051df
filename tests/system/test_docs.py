"""The documentation is true: its commands run, its links work, and it is complete."""

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest
from typer.main import get_command

from pipeline.cli import app, main
from pipeline.cli.common import MORE, ROLES
from pipeline.json_files import json_text
from pipeline.resources import EXAMPLES
from pipeline.simulated.answer_key import AnswerKey
from tests.helpers.commandline import cartlab_here
from tests.helpers.places import ROOT

TOP = ("README.md", "AGENTS.md", "CONTRIBUTING.md")
PAGES = [*(ROOT / name for name in TOP), *sorted((ROOT / "docs").glob("*.md"))]
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
COMMANDS = get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]


def examples(page: Path) -> Iterator[tuple[list[str], int, bool]]:
    """Yield each command of a page: arguments, stated exit status, and whether it is slow."""
    for block in _BLOCK.findall(page.read_text(encoding="utf-8")):
        for line in block.splitlines():
            command, _, remark = line.partition("#")
            words = shlex.split(command)
            if words and words[0] == "cartlab":
                status = re.search(r"exit status (\d)", remark)
                yield words[1:], int(status[1]) if status else 0, "slow" in remark


def run_page(page: Path, monkeypatch, folder: Path, *, slow: bool) -> int:
    """Run a page's commands in order in an empty folder; return how many ran."""
    monkeypatch.chdir(folder)
    ran = 0
    for words, status, is_slow in examples(page):
        if is_slow and not slow:
            continue
        monkeypatch.setattr(sys, "argv", ["cartlab", *words])
        with pytest.raises(SystemExit) as end:
            main()
        assert (end.value.code or 0) == status, " ".join(words)
        ran += 1
    return ran


TUTORIALS = [page for page in PAGES if page.name.startswith(("tutorial", "commands"))]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_commands_of_a_page_work(page, monkeypatch, tmp_path, capsys):
    """Each command of a page, typed in an empty folder, ends with the stated exit status.

    If the page quotes a line about open questions, its own commands print that line.
    """
    assert run_page(page, monkeypatch, tmp_path, slow=False) >= 4
    text, printed = page.read_text(encoding="utf-8"), capsys.readouterr().err
    for quoted in re.findall(r"^- Answer \d questions? in .*$", text, re.MULTILINE):
        assert any(line.startswith(quoted) for line in printed.splitlines())


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_slow_commands_of_a_page_work(page, monkeypatch, tmp_path):
    """The slow commands of a page also end with the exit status that the page states."""
    run_page(page, monkeypatch, tmp_path, slow=True)


def own_rig(folder: Path, *, seed: int) -> None:
    """Write recordings of a simulated cart as those of the rig on the page, without a table."""
    cartlab_here("simulate", "--preset", "throne-1dof", "--seed", seed, "--out", folder / "bench")
    columns = {"time": ("t / s", 1), "input": ("current (A)", 2), "x1": ("carriage (mm)", 10)}
    (folder / "data").mkdir()
    for file in (folder / "bench" / "data").glob("*.csv"):
        if file.stem.startswith(("decay", "step", "sweep")):
            frame = pd.read_csv(file)[list(columns)]
            for name, (_, scale) in columns.items():
                frame[name] *= scale
            frame.columns = [heading for heading, _ in columns.values()]
            frame.to_csv(folder / "data" / file.name, sep=";", decimal=",", index=False)
    shutil.rmtree(folder / "bench")


@pytest.mark.slow
@pytest.mark.sample
def test_the_page_on_an_own_lab_works(monkeypatch, tmp_path):
    """With a rig's files, every command and table of the page works and earns all points."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "own-lab.md").read_text(encoding="utf-8")
    own_rig(tmp_path / "my-rig", seed=1)
    ran = []
    for kind, block in re.findall(r"^```(sh|toml)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        if kind == "toml":
            path = Path(block.split()[1].rstrip(","))
            before = path.read_text(encoding="utf-8") if "at the end" in block else ""
            path.write_text(before + block, encoding="utf-8")
            continue
        for line in block.splitlines():
            command, *arguments = shlex.split(line)
            assert command == "cartlab"
            if "class" in arguments:
                for seed, team in ((2, "team-1"), (3, "team-2")):
                    own_rig(tmp_path / "class" / team, seed=seed)
                    tables = (tmp_path / "my-rig" / "submission.toml").read_text(encoding="utf-8")
                    tables = tables.replace('"instructor"', f'"{team}"')
                    (tmp_path / "class" / team / "submission.toml").write_text(
                        tables, encoding="utf-8"
                    )
            done = cartlab_here(*arguments)
            assert done.returncode == 0, done.stderr
            ran.append(arguments[0])
    assert {"fill", "report", "check", "new-rubric", "check-rubric", "grade", "export"} <= set(ran)
    for folder in ("trial", "grades"):
        table = pd.read_csv(tmp_path / folder / "grades.csv")
        assert set(table["points"]) == {20}


def conclusions(team: Path) -> str:
    """Return what the report and the gap of a team say, as a student types it."""
    results = json.loads((team / "report" / "results.json").read_text(encoding="utf-8"))
    gap = json.loads((team / "gap" / "gap.json").read_text(encoding="utf-8"))
    lines = ["", "[reported.final]"]
    lines += [f"{row['name']} = {row['final']:.3g}" for row in results["parameters"]]
    for effect in gap["effects"]:
        lines += [f"[reported.effects.{effect['effect']}]"]
        values = {**effect["where"], **{n: p["value"] for n, p in effect["parameters"].items()}}
        lines += [f"{name} = {value:.3g}" for name, value in values.items()]
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.sample
def test_the_page_on_a_course_works(monkeypatch, tmp_path):
    """What the commands of the page show of a team's bench earns all points for its effect.

    A team that copies the numbers of its neighbour loses most of them. This key draws another
    effect for each.
    """
    monkeypatch.chdir(tmp_path)
    key = AnswerKey(secret="course", teams={})
    Path("key.json").write_text(json_text(key), encoding="utf-8")
    teams = [Path("teams", name) for name in ("team-1", "team-2")]
    for arguments, status, _ in examples(ROOT / "docs" / "course.md"):
        if arguments[0] == "grade":
            typed = conclusions(teams[0])
            for team in teams:
                with (team / "submission.toml").open("a", encoding="utf-8") as file:
                    file.write(typed)
        done = cartlab_here(*arguments)
        assert done.returncode == status, done.stderr
    grades = pd.read_csv("grades/grades.csv").set_index("submission")
    assert grades.loc["team-1", "points"] == 20
    assert grades.loc["team-2", "effects"] == 0
    assert grades.loc["team-2", "points"] < 12


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_and_option_is_documented(command):
    """`docs/commands.md` has a section for each command, with each of its options."""
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    sections = re.split(r"^### ", text, flags=re.MULTILINE)
    (section,) = [s for s in sections if re.match(rf"`cartlab {command}(?![\w-])", s)]
    for parameter in COMMANDS[command].params:
        for option in (*parameter.opts, *parameter.secondary_opts):
            if option.startswith("--") and option not in ("--help", "--pdf"):
                assert option in section, f"{command} {option}"


@pytest.mark.parametrize(
    ("page", "group", "command"),
    [
        ("README.md", r"^- \*\*(\w+):\*\* (.*?)(?=^- \*\*|\n\n)", r"`cartlab ([\w-]+)`"),
        ("docs/commands.md", r"^## (\w+)\n(.*?)(?=^## |\Z)", r"^### `cartlab ([\w-]+)"),
    ],
)
def test_commands_are_grouped_by_role(page, group, command):
    """README and `docs/commands.md` group the commands as `cartlab --help` does."""
    text = (ROOT / page).read_text(encoding="utf-8")
    groups = re.findall(group, text, re.DOTALL | re.MULTILINE)
    listed = {role: re.findall(command, part, re.MULTILINE) for role, part in groups}
    assert {role: tuple(listed[role]) for role in ROLES} == ROLES
    assert set(listed[MORE]) == set(COMMANDS) - {name for names in ROLES.values() for name in names}


@pytest.mark.slow
@pytest.mark.sample
def test_every_file_of_a_work_folder_is_documented(tmp_path):
    """All that `fill`, `check` and `report` leave in a submission is named in the documentation."""
    folder = tmp_path / "one-cart"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    before = {path.name for path in folder.rglob("*")}
    for command in (["fill"], ["check"], ["report", "--no-pdf", "--tables", "--plots"]):
        cartlab_here(command[0], folder, *command[1:])
    left = {path.name for place in (folder, folder / "report") for path in place.iterdir()}
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    new = left - before
    assert {"report", ".turn", "questions.json"} <= new
    assert [name for name in sorted(new) if name not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    """Every linked or shown file exists, and so does every heading that a link names."""
    for target in _LINK.findall(page.read_text(encoding="utf-8")):
        if target.startswith(("http://", "https://")):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        assert file.is_file(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}
            assert anchor in slugs, target


def test_every_picture_is_shown_somewhere():
    """Every picture in docs is shown on at least one page."""
    shown = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in _LINK.findall(page.read_text(encoding="utf-8"))
    }
    for picture in (ROOT / "docs" / "images").rglob("*.*"):
        assert picture.resolve() in shown, picture.name


def test_the_files_named_to_contributors_exist():
    """Every path in CONTRIBUTING.md exists, unless the reader is asked to create it."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = re.findall(r"`((?:pipeline|tests|docs|templates|rubrics)/[\w./-]+)`", text)
    assert len(paths) > 30
    for path in paths:
        assert "YOURS" in path or path.endswith("__pycache__") or (ROOT / path).exists(), path


def test_the_hooks_before_a_commit_are_the_checks_of_ci():
    """Each call of ruff, pyright and mkdocs in `.ci/run` is also a pre-commit hook."""
    checked = re.findall(
        r"^(?:\w+=\S+ )?((?:ruff|pyright|mkdocs)\b.*)", (ROOT / ".ci/run").read_text(), re.MULTILINE
    )
    hooks = re.findall(
        r"^ +name: (.*)\n +entry: (.*)",
        (ROOT / ".pre-commit-config.yaml").read_text(),
        re.MULTILINE,
    )
    assert len(checked) == len(hooks) > 0
    for line, (name, entry) in zip(checked, hooks, strict=True):
        assert line.startswith(name)
        assert entry.startswith(name)
