"""Write a model as source code: `model.c` with its header, `model.m`, and the FMU's sources."""

from collections.abc import Callable
from functools import partial
from typing import Any

from pipeline import __version__
from pipeline.plant.export.description import Description
from pipeline.plant.export.syntax import in_c, in_matlab
from pipeline.resources import TEMPLATES

TITLE = f"Carts on springs with the effects that cartlab {__version__} found"

_LETTERS = str.maketrans({"µ": "u", "μ": "u", "°": "deg", "²": "^2", "³": "^3", "·": "*"})


def c_sources(description: Description) -> dict[str, str]:
    """Return the texts of `model.h` and `model.c`."""
    return {name: render(name, description, code=in_c) for name in ("model.h", "model.c")}


def matlab_source(description: Description) -> str:
    """Return the text of `model.m`."""
    bodies = [body.name for body in description.bodies]
    bristles = [bristle.name for bristle in description.bristles]
    code = partial(in_matlab, bodies=bodies, bristles=bristles)
    return render("model.m", description, code=code)


def render(
    name: str, description: Description, *, code: Callable[[str], str] = in_c, **more: Any
) -> str:
    """Fill in a template of `templates/model`; `code` translates expressions."""
    # Imported late, because this takes 50 ms.
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES / "model"),
        undefined=jinja2.StrictUndefined,
        autoescape=name.endswith(".xml"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    bodies = [body.name for body in description.bodies]
    number = {name: f"{place}" for place, name in enumerate(bodies, start=1)}
    environment.filters |= {"code": code, "comment": comment, "number": number.__getitem__}
    return environment.get_template(f"{name}.j2").render(
        d=description, title=TITLE, units=description.units, **more
    )


def comment(text: str) -> str:
    """Return a text that is safe in a comment: only ASCII, and nothing that ends the comment."""
    plain = text.translate(_LETTERS).encode("ascii", "replace").decode().replace("\\", "/")
    return plain.replace("/*", "/ *").replace("*/", "* /").replace("??", "? ?")
