"""Write the zip that Gradescope builds an autograder from.

The zip contains cartlab's source files, because Gradescope's machines cannot install cartlab from
the package index. Source files also need no build tool on the instructor's computer.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import pipeline
from pipeline.errors import ConfigError
from pipeline.grading.autograder.pins import pin_requirements
from pipeline.grading.grade import Grade
from pipeline.grading.publish.gradescope import results_text
from pipeline.grading.publish.view import new_view
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import find_rubric, parse_rubric, rubric_source
from pipeline.grading.words import WORDS
from pipeline.output import write_file, zip_bytes
from pipeline.resources import TEMPLATES

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
        yield (
            script.name,
            script.read_bytes().replace(b"\r\n", b"\n"),
        )  # bash cannot read Windows line ends
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
