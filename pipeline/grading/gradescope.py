"""Gradescope: the zip from which it builds an autograder, the grading there, and the results.

Names of folders, keys and values are those of Gradescope's *Autograder Specifications*. The zip
contains cartlab's source files, because Gradescope's machines cannot install cartlab from the
package index; so no build tool is needed on the instructor's computer either. The script
`run_autograder` runs this module.

If students must find the numbers themselves (`see = "check"`), they see no computed number. Because
they may resubmit, and partial points would reveal the error of a number, they see points only after
the due date.
"""

import importlib.metadata as installed
import json
import sys
import tempfile
from collections.abc import Iterator, Set
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import pipeline
from pipeline.errors import ConfigError
from pipeline.grading.batch.runner import Grader
from pipeline.grading.grade import Criterion, Grade, read_grade
from pipeline.grading.gradings import HandIn, Setup
from pipeline.grading.publish.view import GradeView, new_view
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import find_rubric, load_rubric, parse_rubric, rubric_source
from pipeline.grading.words import WORDS
from pipeline.output import write_file, zip_bytes
from pipeline.resources import TEMPLATES
from pipeline.words.text import with_symbols


def results_text(view: GradeView) -> str:
    """Return a grade as `results.json`; the same grade gives the same bytes."""
    grade = view.grade
    document = {
        "score": grade.points,
        "output": "\n".join(_grade_lines(view)),
        "output_format": "text",
        "test_output_format": "text",
        "test_name_format": "text",
        "stdout_visibility": "hidden",
        "tests": [
            {
                "score": judged.points,
                "max_score": judged.out_of,
                **_status(judged, view),
                "name": judged.title or judged.id,
                "number": str(number),
                "output": _criterion_text(judged, view),
                "tags": [judged.id],
                "visibility": "after_due_date" if view.hides_numbers else "visible",
            }
            for number, judged in enumerate(grade.criteria, start=1)
        ],
        "extra_data": {"flags": [flag.code for flag in grade.flags]},
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _grade_lines(view: GradeView) -> list[str]:
    """Return the lines that students see about the whole grade."""
    how = " automatically, so points were given by hand" if view.is_by_hand else ""
    if view.grade.status == "failed":
        lines = [f"Could not be graded{how}: {view.grade.reason}"]
    else:
        lines = [WORDS.text("gradescope_hidden")] if view.hides_numbers else []
    return [*lines, *view.flag_lines(), *view.total_lines()]


def _status(judged: Criterion, view: GradeView) -> dict[str, str]:
    """Return the status of a criterion; without one, Gradescope compares its points."""
    if judged.id in view.grade.open:
        return {}
    return {"status": "passed" if judged.outcome == "pass" else "failed"}


def _criterion_text(judged: Criterion, view: GradeView) -> str:
    """Return the text that students see about a criterion."""
    why = "; ".join(map(with_symbols, view.reasons(judged)))
    return ": ".join([WORDS.text(f"outcome_{judged.outcome}"), *([why] if why else [])])


# Gradescope's machines run Linux; this computer may run another system.
_LINUX: dict[str, str | Set[str]] = {
    "os_name": "posix",
    "sys_platform": "linux",
    "platform_system": "Linux",
    "platform_machine": "x86_64",
}


def pin_requirements(package: str = "cartlab") -> list[str]:
    """Return `name==version` for each direct and indirect requirement of a package on Linux.

    A requirement that is not installed on this computer is left out. On Gradescope, pip then
    chooses its version.

    Raises
    ------
    ConfigError : `package` is not installed.
    """
    pinned: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(package, "")]
    while waiting:
        name, extra = one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        try:
            found = installed.distribution(name)
        except installed.PackageNotFoundError:
            if name == package:
                raise ConfigError(f"{package} is not installed here: run `pip install .`") from None
            continue
        if name != package:
            pinned[canonicalize_name(name)] = Version(found.version).public
        for needed in map(Requirement, found.requires or ()):
            marker = needed.marker
            if marker is None or marker.evaluate({**_LINUX, "extra": extra}):
                waiting += [(needed.name, more) for more in ("", *needed.extras)]
    return [f"{name}=={version}" for name, version in sorted(pinned.items())]


_SCRIPTS = TEMPLATES / "gradescope"


def write_autograder(rubric_file: Path, out: Path) -> tuple[str, ...]:
    """Write the zip; return the instructor's next steps on Gradescope, one phrase each.

    Parameters
    ----------
    rubric_file : path of a rubric, or the name of a rubric that comes with cartlab.

    Raises
    ------
    ConfigError : the rubric is not valid, or `out` is a folder or does not end in `.zip`.
    """
    if out.suffix.lower() != ".zip" or out.is_dir():
        raise ConfigError(f"{out}: an autograder is one zip file; name it with --out")
    path = find_rubric(rubric_file)
    text = rubric_source(path)
    rubric = parse_rubric(text, where=path.name)
    scripts = [script.name for script in _SCRIPTS.iterdir()]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, zip_bytes(_files(text, rubric), programs=scripts))
    return tuple(_tasks(rubric))


def _files(text: str, rubric: Rubric) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of each file in the zip."""
    for script in _SCRIPTS.iterdir():
        # bash cannot read Windows line ends
        yield script.name, script.read_bytes().replace(b"\r\n", b"\n")
    yield "python-version", f"{sys.version_info.major}.{sys.version_info.minor}\n".encode()
    head = f"# cartlab {pipeline.__version__} was installed with:"
    yield "requirements.txt", "\n".join([head, *pin_requirements(), ""]).encode()
    yield "rubric.toml", text.encode()
    reason = WORDS.text("gradescope_unfinished")
    unfinished = Grade.failed("", reason, out_of=rubric.out_of, authors=(), days_late=0.0)
    yield "unfinished.json", results_text(new_view(unfinished, rubric)).encode()
    package = Path(pipeline.__file__).parent
    for path in package.rglob("*.py"):
        yield f"cartlab/pipeline/{path.relative_to(package).as_posix()}", path.read_bytes()
    for path in TEMPLATES.rglob("*"):
        if path.is_file():
            where = path.relative_to(TEMPLATES).as_posix()
            yield f"cartlab/pipeline/_resources/templates/{where}", path.read_bytes()


def _tasks(rubric: Rubric) -> Iterator[str]:
    yield f"on Gradescope, set the autograder points to {rubric.out_of:g}"
    if rubric.late.percent_per_day:
        yield "nothing is deducted for late work: set the late policy on Gradescope"


_TIME_LIMIT = 420.0  # s; Gradescope stops after 600 s, including the start of the container


def grade_upload(root: Path) -> str:
    """Grade `submission/` and write `results/results.json`; return the traceback of a grader error.

    Gradescope shows the returned text only to the instructor; it is "" if there was no error.
    """
    rubric = load_rubric(root / "source" / "rubric.toml")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        setup = Setup(rubric=rubric, scratch=Path(scratch), time_limit=_TIME_LIMIT)
        grader = Grader(setup)
        try:
            # Without lateness: Gradescope knows the extensions and deducts points itself.
            hand_in = HandIn(id="submission", sources=(root / "submission",))
            grading = grader.run(hand_in)
        finally:
            grader.close()
    text = results_text(new_view(read_grade(grading.grade), rubric))
    write_file(root / "results" / "results.json", text)
    return grading.detail


if __name__ == "__main__":
    sys.stdout.write(grade_upload(Path(sys.argv[1])))
