"""In a class with hostile submissions, each gets a row, and none harms the honest ones."""

import base64
import csv
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import html5lib
import pytest

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.intake.files import digest, open_submission
from pipeline.grading.intake.find import find_hand_ins
from pipeline.ingest.fill import fill_submission, passed_over
from pipeline.simulated.submission import Students, write_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.hostile import SECRET, write_hostile
from tests.helpers.places import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pipes and links of POSIX")

NOBODY = 65_534
HONEST = ("honest-1", "honest-2")

# Python itself logs what each process of a run is about to do.
AUDIT = """\
import os, sys
_log = os.open(os.environ["AUDIT_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
_told = {"socket.connect", "socket.getaddrinfo", "socket.sendto", "os.system", "os.exec",
         "os.posix_spawn", "subprocess.Popen", "os.link", "os.symlink", "os.chmod", "os.chown",
         "os.remove", "os.rename", "os.mkdir", "os.rmdir", "shutil.rmtree", "pickle.find_class"}
def _tell(event, args):
    if event == "open":
        if not isinstance(args[0], (str, bytes)) or not args[2] & (os.O_WRONLY | os.O_RDWR):
            return
    elif event not in _told:
        return
    at = args[1] if event == "os.rename" else args[0]
    if event in ("os.remove", "os.rmdir") and args[1] != -1:  # relative to a folder that is open
        at = os.path.join(os.readlink(f"/proc/self/fd/{args[1]}"), os.fsdecode(at))
    elif event == "open" or event.startswith(("os.", "shutil.")):
        at = at if isinstance(at, int) else os.path.abspath(os.fsdecode(at))
    os.write(_log, f"{event}\\t{at!r}\\n".encode("utf-8", "backslashreplace"))
sys.addaudithook(_tell)
"""


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((2, 20), marks=[pytest.mark.slow, pytest.mark.sample]),
        pytest.param((3, 400), marks=pytest.mark.slow),
    ],
)
def graded(request, tmp_path_factory):
    """Grade a hostile class; return its folder, the names, and the audit log of all processes."""
    base = tmp_path_factory.mktemp("hostile")
    school = base / "school"
    for number, place in enumerate((*(school / name for name in HONEST), base / "spoilt")):
        write_submission(place, "throne-1dof", seed=number, compact=True,
                         reported=True, students=Students(authors=(f"s{number}",)))  # fmt: skip
    shutil.copytree(school, base / "alone")
    seed, drawn = request.param
    names = write_hostile(school, _small(base / "spoilt"), seed=seed, every=1, drawn=drawn)
    (base / "hook").mkdir()
    (base / "hook" / "sitecustomize.py").write_text(AUDIT, encoding="utf-8")
    before = _below(school), _below(base / "outside")
    done = _grade(base, "school", figures=seed == 2)
    assert (_below(school), _below(base / "outside")) == before
    yield base, names, done
    for path in school.rglob("*"):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o755)  # so that the folder can be removed


def _small(folder: Path) -> dict[str, bytes]:
    """Return the files of a submission with few of its dwells, which is quick to grade."""
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.*")}
    head, *runs = files["submission.toml"].decode().split("[[experiments]]\n")
    dropped = [run for run in runs if re.match(r'id = "sine-(?!04|07|10|13|16|20)', run)]
    kept = "[[experiments]]\n".join([head, *(run for run in runs if run not in dropped)])
    gone = {match[1] for run in dropped if (match := re.search(r'file = "(.*)"', run))}
    return {name: raw for name, raw in files.items() if name not in gone} | {
        "submission.toml": kept.encode()
    }


def _grade(base: Path, what: str, *, figures: bool = False) -> subprocess.CompletedProcess[str]:
    package = str(ROOT)
    return subprocess.run(
        [sys.executable, "-m", "pipeline", "grade", what, "--rubric", "throne-1dof", "--jobs", "2",
         "--out", f"out-{what}", "--figures" if figures else "--no-figures"],
        cwd=base,
        env={**os.environ, "PYTHONPATH": f"{base / 'hook'}{os.pathsep}{package}",
             "AUDIT_LOG": str(base / "audit.txt"), "TMPDIR": str(base / "hook"),
             "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )  # fmt: skip


def _below(folder: Path) -> list[tuple[str, int]]:
    return sorted(
        (os.path.join(at, name), os.lstat(os.path.join(at, name)).st_size)  # noqa: PTH118
        for at, folders, files in os.walk(folder)
        for name in (*folders, *files)
    )


def test_every_submission_has_a_row_with_a_reason(graded):
    """Each hostile submission gets a row with a one-line reason; the grader itself never fails."""
    base, names, done = graded
    assert done.returncode == 1, done.stderr
    assert len(names) >= 100
    with (base / "out-school" / "grades.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(names) + len(HONEST)
    assert len({row["submission"].casefold() for row in rows}) == len(rows)
    failed = [row for row in rows if row["status"] == "failed"]
    assert len(failed) > len(names) // 2
    for row in failed:
        assert row["reason"].isprintable(), row
        assert row["reason"], row
        assert "the grader" not in row["reason"], row
        assert "maximum recursion" not in row["reason"], row
    with Gradebook(base / "out-school") as book:
        outcomes = [book.known(entry.key) for entry in book.entries()]
    assert [o.reason for o in outcomes if o and (o.detail or not o.settled)] == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux names the file of a descriptor")
def test_grading_writes_only_into_its_folder_and_makes_no_connection(graded):
    """Grading writes only into its own folder, makes no connection, starts only known programs."""
    base, _, _ = graded
    lines = (base / "audit.txt").read_text(encoding="utf-8").splitlines()
    events = [line.partition("\t")[::2] for line in lines]
    assert {"open", "subprocess.Popen"} <= {event for event, _ in events}  # the audit log works
    own = (str(base / "out-"), str(base / "hook"), os.devnull)
    compiled = ("__pycache__", "numba", "matplotlib", "fontconfig")  # the caches of libraries
    caches = str(Path.home() / ".cache")  # their folder, made by the first of them
    for event, at in events:
        if event == "subprocess.Popen":
            program = at.strip("'")
            libraries = ("fc-list", "lscpu", "uname")  # look for fonts, threads and the processor
            assert program in (sys.executable, "") or Path(program).name in libraries, at
        elif event == "pickle.find_class":
            assert at.strip("'") not in ("os", "posix", "nt"), at
        else:
            assert not event.startswith(("socket", "os.system", "os.exec")), (event, at)
            path = at.strip("'\"")
            inside = path == caches or path.startswith(own) or any(name in at for name in compiled)
            assert inside, (event, at)
    assert [path.name for path in (base / "hook").iterdir()] == ["sitecustomize.py"]
    assert not Path("/tmp/escaped").exists()
    out = base / "out-school"
    assert sorted(path.name for path in out.iterdir()) == [
        ".lock", "class.html", "feedback", "gradebook.sqlite", "grades.csv", "repairs", "run.json",
    ]  # fmt: skip
    assert not list(base.glob("escaped*"))


def test_the_honest_are_graded_as_if_they_were_alone(graded):
    """Honest submissions get the same grade, byte for byte, with or without hostile ones."""
    base, _, _ = graded
    _grade(base, "alone")
    for name in HONEST:
        ours, theirs = (base / f"out-{what}" / "feedback" / name for what in ("school", "alone"))
        assert (ours / "grade.json").read_bytes() == (theirs / "grade.json").read_bytes()


def test_no_page_runs_or_loads_anything_hostile(graded):
    """Pages have only our own script, no event handlers, and no addresses of other hosts."""
    base, _, _ = graded
    out = base / "out-school"
    pages = [out / "class.html", *sorted((out / "feedback").glob("*/feedback.html"))]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert SECRET not in text
        (script,) = re.findall(r"<script[^>]*>(.*?)</script>", text, re.DOTALL)
        hashed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"script-src 'sha256-{hashed}'" in text  # no other script can run
        assert "alert(1)" not in script
        for tag, attributes in _elements(text):
            assert tag not in ("iframe", "object", "embed", "base", "form", "frame"), page
            for name, value in attributes.items():
                assert not name.startswith("on"), (page, name)
                if name in ("href", "src", "action", "srcset", "poster", "data", "xlink:href"):
                    assert urlsplit(value).scheme in ("", "data"), (page, value)
                    assert not value.startswith("//"), (page, value)


def _elements(text: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the elements of a page as HTML parsers see them, without namespaces."""
    tree = html5lib.parse(text, namespaceHTMLElements=False)
    for element in tree.iter():
        if isinstance(element.tag, str):
            plain = {re.sub(r"^\{.*\}", "", str(k)): v for k, v in element.attrib.items()}
            yield re.sub(r"^\{.*\}", "", element.tag), plain


def test_no_cell_is_a_formula_and_all_json_is_valid(graded):
    """No cell of the class table or of a platform's table is a formula; all JSON is valid."""
    base, _, _ = graded
    out = base / "out-school"
    for lms in ("canvas", "moodle", "gradescope"):
        done = cartlab_here("export", out, "--lms", lms, "--out", base / "lms")
        assert done.returncode == 1  # some graded teams have no name
        assert "so not exported" in done.stderr
    tables = [out / "grades.csv", *(base / "lms").glob("*.csv")]
    assert len(tables) == 4
    for table in tables:
        text = table.read_text(encoding="utf-8")
        readings = [csv.reader(io.StringIO(text), delimiter=mark) for mark in ",;"]
        cells = [cell for rows in readings for row in rows for cell in row]
        for cell in cells:
            number = re.fullmatch(r"[+-]?[\d.]+(e[+-]?\d+)?", cell)
            assert number or not cell.lstrip().startswith(("=", "+", "-", "@", "\t")) or cell == "-"
            assert SECRET not in cell

    def no(word: str) -> None:
        raise AssertionError(word)

    documents = [*out.rglob("*.json"), *(base / "lms").rglob("results.json")]
    assert len(documents) > 200
    for path in documents:
        text = path.read_text(encoding="utf-8")
        assert SECRET not in text
        json.loads(text, parse_constant=no)


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root changes user"
)
def test_an_unreadable_folder_affects_only_its_row(tmp_path_factory):
    """If a folder or file may not be read, only its own submission cannot be opened."""
    base = tmp_path_factory.mktemp("rights")
    for name in ("folder", "inside", "toml", "listed", "good"):
        (base / "class" / name / "data").mkdir(parents=True)
        (base / "class" / name / "submission.toml").write_text("version = 1\n", encoding="utf-8")
    (base / "class" / "folder").chmod(0)
    (base / "class" / "inside" / "data").chmod(0)
    (base / "class" / "toml" / "submission.toml").chmod(0)
    (base / "class" / "listed").chmod(0o444)
    for path in (base, *base.parents):
        if path.stat().st_mode & 0o005 != 0o005:
            path.chmod(0o755)
    (base / "scratch").mkdir(mode=0o777)
    (base / "scratch").chmod(0o777)
    os.seteuid(NOBODY)
    try:
        found = {h.id: h for h in find_hand_ins([base / "class"], scratch=base / "scratch")}
        assert sorted(found) == ["folder", "good", "inside", "listed", "toml"]
        assert found["folder"].problem == found["listed"].problem
        assert found["folder"].problem.endswith("(Permission denied)")
        assert len({digest(hand_in.sources) for hand_in in found.values()}) >= 3
        for name in ("inside", "toml"):
            with pytest.raises(PermissionError):
                open_submission(found[name].sources, base / "scratch" / name)
        assert open_submission(found["good"].sources, base / "scratch" / "good")
    finally:
        os.seteuid(0)


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root changes user"
)
@pytest.mark.parametrize("closed", ["data", "data/more"])
def test_a_folder_that_may_not_be_opened_is_named(tmp_path_factory, closed):
    """Recordings in a folder that may not be opened are reported, not taken for missing."""
    folder = tmp_path_factory.mktemp("closed") / "team"
    (folder / closed).mkdir(parents=True)
    (folder / closed / "step.csv").write_text("t,u,x1\n0,1,0\n", encoding="utf-8")
    (folder / closed).chmod(0)
    for path in (folder, *folder.parents):
        if path.stat().st_mode & 0o005 != 0o005:
            path.chmod(0o755)
    os.seteuid(NOBODY)
    try:
        assert [one.file for one in passed_over(folder)] == [closed]
        with pytest.raises(ConfigError, match=rf"not read: {closed} \(.*Permission denied"):
            fill_submission(folder)
    finally:
        os.seteuid(0)


def test_a_file_changed_meanwhile_affects_only_its_row(tmp_path):
    """If a submission's file disappears or changes during grading, its digest differs."""
    for name in ("gone", "changed"):
        (tmp_path / "class" / name).mkdir(parents=True)
        (tmp_path / "class" / name / "submission.toml").write_text(
            "version = 1\n", encoding="utf-8"
        )
    found = {h.id: h for h in find_hand_ins([tmp_path / "class"], scratch=tmp_path / "scratch")}
    before = {name: digest(hand_in.sources) for name, hand_in in found.items()}
    shutil.rmtree(tmp_path / "class" / "gone")
    (tmp_path / "class" / "changed" / "submission.toml").write_text("version = 2", encoding="utf-8")
    for name, hand_in in found.items():
        assert digest(hand_in.sources) != before[name]
    with pytest.raises(OSError, match="No such file"):
        open_submission(found["gone"].sources, tmp_path / "opened")
    assert open_submission(found["changed"].sources, tmp_path / "opened" / "changed")
