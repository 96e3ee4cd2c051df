"""Write the zip that Gradescope builds an autograder from.

The zip contains the source files of cartlab. Gradescope's machines can install packages from the
index, but cartlab is not there; and plain files need no build tool on the instructor's computer.
"""

import io
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pipeline
from pipeline.errors import ConfigError
from pipeline.grading.autograder.pins import pin_requirements
from pipeline.grading.grade import Grade
from pipeline.grading.publish.gradescope import results_text
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import find_rubric, parse_rubric, rubric_source
from pipeline.grading.words import WORDS
from pipeline.output import write_file
from pipeline.resources import TEMPLATES

_SCRIPTS = TEMPLATES / "gradescope"
_FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # so that the same files give the same bytes
_PROGRAM, _FILE = 0o100755 << 16, 0o100644 << 16  # file modes, in the format of zip files


def write_autograder(rubric_file: Path, out: Path) -> tuple[str, ...]:
    """Write the zip; return what the instructor must do on Gradescope's side.

    Parameters
    ----------
    rubric_file : a file, or the name of a shipped rubric.

    Raises
    ------
    ConfigError : the rubric has mistakes, or `out` is no name for a zip file.
    """
    if out.suffix.lower() != ".zip" or out.is_dir():
        raise ConfigError(f"{out}: an autograder is one zip file; name it with --out")
    path = find_rubric(rubric_file)
    text = rubric_source(path)
    rubric = parse_rubric(text, where=path.name)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(_files(text, rubric)):
            info = zipfile.ZipInfo(name, _FIXED_TIME)
            info.external_attr = _PROGRAM if (_SCRIPTS / name).is_file() else _FILE
            info.create_system = 3  # Unix, so that the file modes above apply
            archive.writestr(info, content, zipfile.ZIP_DEFLATED)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, buffer.getvalue())
    return tuple(_tasks(rubric))


def _files(text: str, rubric: Rubric) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each file in the zip."""
    for script in _SCRIPTS.iterdir():
        yield (
            script.name,
            script.read_bytes().replace(b"\r\n", b"\n"),
        )  # bash refuses line ends with \r
    yield "python-version", f"{sys.version_info.major}.{sys.version_info.minor}\n".encode()
    head = f"# cartlab {pipeline.__version__} was installed with:"
    yield "requirements.txt", "\n".join([head, *pin_requirements(), ""]).encode()
    yield "rubric.toml", text.encode()
    reason = WORDS.text("gradescope_unfinished")
    unfinished = Grade.failed("", reason, out_of=rubric.out_of, authors=(), days_late=0.0)
    yield "unfinished.json", results_text(unfinished, rubric=rubric).encode()
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
