"""Write the catalogue of effects, with pictures, as the page `effects.md`."""

import textwrap
from collections.abc import Iterator
from pathlib import Path

from pipeline.output import write_file
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import Effect
from pipeline.report.builder import PageBuilder
from pipeline.report.effect_texts import parameter_text
from pipeline.report.effects import BENCH, effect_picture, hiding_option
from pipeline.report.figures.style import drawing
from pipeline.simulated.hidden import usual_term
from pipeline.words.math import to_tex
from pipeline.words.phrases import phrases

DOCS = Path(__file__).parent
IMAGES = Path("images", "effects")
_ACTS_ON = {"cart": "one cart", "spring": "one spring", "input": "the drive"}


def main() -> None:
    """Write the page and every picture."""
    (DOCS / IMAGES).mkdir(parents=True, exist_ok=True)
    write_file(DOCS / "effects.md", effects_page())
    with drawing():
        for effect in CATALOGUE:
            term = usual_term(effect, PRESETS[BENCH])
            picture = effect_picture(PageBuilder(), term, PRESETS[BENCH], bench=BENCH)
            write_file(DOCS / IMAGES / f"{effect.key}.svg", picture.svg)


def effects_page() -> str:
    """Return the page in Markdown, with all words taken from the catalogue."""
    head = [
        "# The effects",
        "<!-- written by python -m docs.effects_page -->",
        _wrapped(phrases("effects").text("effects")),
        _wrapped(
            "[`cartlab gap`](gap.md) looks for these effects. To simulate a bench with one of "
            f"them, add its `--hide` option to `cartlab simulate --preset {BENCH} --out bench`."
        ),
    ]
    return "\n\n".join([*head, *(part for e in CATALOGUE for part in _entry(e))]) + "\n"


def _entry(effect: Effect) -> Iterator[str]:
    term = usual_term(effect, PRESETS[BENCH])
    yield f"## {effect.title}"
    yield _wrapped(f"`{effect.key}` (acts on {_ACTS_ON[effect.place]}): {effect.sentence}")
    yield f"```math\n{to_tex(effect.formula)}\n```"
    picture = (IMAGES / f"{effect.key}.svg").as_posix()
    yield f"![Fingerprint]({picture})"
    parameters = ", ".join(parameter_text(p) for p in effect.parameters if p.reported)
    facts = {
        "Parameters": parameters,
        "Option": f"`{hiding_option(term)}`",
        "Fingerprint": effect.fingerprint,
        "Deciding experiment": effect.deciding_run,
        "Easily mistaken for": effect.equivalent,
        "Read": effect.reference,
    }
    yield "\n".join(_wrapped(f"- **{name}**: {fact}") for name, fact in facts.items() if fact)


def _wrapped(text: str) -> str:
    indent = "  " if text.startswith("- ") else ""
    return textwrap.fill(text, 118, subsequent_indent=indent, break_on_hyphens=False)


if __name__ == "__main__":
    main()
