"""Make a commented submission folder for a student to fill in."""

from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.names import parameter_names
from pipeline.output import write_file
from pipeline.resources import TEMPLATES
from pipeline.submission.load import NAME, spring_names
from pipeline.submission.models import MOST_CARTS

_NOTES = """\
<!-- What you write here becomes the discussion of the report (Markdown). Comments like this do not.

     `cartlab report` asks the questions that your data raise, for example about zeta_b. Answer
     under a heading with that name; the report shows the answer below the question:

     ## zeta_b
     The decay saw …

     Everything else is free text: what limits the model? What would you record next? -->
"""


def new_submission(folder: Path, *, carts: int) -> None:
    """Write `submission.toml`, `notes.md` and an empty `data/` for a bench with `carts` carts.

    Raises
    ------
    ConfigError : the folder is not empty, or the number of carts is too large.
    """
    if not 1 <= carts <= MOST_CARTS:
        raise ConfigError(f"carts: expected 1 to {MOST_CARTS}, found {carts}")
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: exists already and is not empty; choose a new folder")
    write_templates(folder, carts=carts)


def write_templates(folder: Path, *, carts: int) -> None:
    """Write the files of `new_submission` into a folder that may already hold recordings.

    An existing `submission.toml` or `notes.md` stays as it is.
    """
    # Imported late, because this takes 50 ms.
    import jinja2

    source = (TEMPLATES / f"{NAME}.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = environment.from_string(source).render(
        carts=carts,
        springs=["true"] * (carts + 1),
        spring_names=spring_names(carts),
        ratio_names=[f"x{i}" for i in range(1, carts + 1)],
        zeros=["0.0"] * (2 * carts),
        names=parameter_names(carts),
    )
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for name, content in ((NAME, text), ("notes.md", _NOTES)):
        if not (folder / name).exists():
            write_file(folder / name, content)
