"""The catalogue of effects as a page: what each is, how it looks in data, what decides."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline import __version__
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.nonlinear.effects import Effect, Term
from pipeline.report.document import (
    Block,
    Code,
    Document,
    Picture,
    Section,
    Span,
    bullet_list,
    cell,
    make_table,
    paragraph,
    spans,
)
from pipeline.report.effects.figures import effect_figure, fingerprint_words
from pipeline.report.effects.words import INPUT, POSITION, parameter_text
from pipeline.report.equations.model import formula
from pipeline.report.figures.style import WIDTH, drawing
from pipeline.report.figures.svg import to_svg
from pipeline.report.math.tex import from_tex
from pipeline.report.numbers import significant
from pipeline.report.phrases import phrases
from pipeline.report.render.write import write_document
from pipeline.synthesis.hidden import usual_term

_WORDS = phrases("report")
BENCH = "throne-2dof"  # the smallest with a spring between two carts


def render_effects(
    effects: Sequence[Effect], out: Path, *, progress: Callable[[str], None] | None = None
) -> None:
    """Write `effects.html` and `figures/*.svg` into the folder `out`; same bytes each time."""
    write_document(build_gallery(effects, progress=progress), out, name="effects", pdf=False)


def build_gallery(
    effects: Sequence[Effect], *, progress: Callable[[str], None] | None = None
) -> Document:
    """Return the catalogue with a picture of each effect on a simulated bench."""
    entries = []
    with drawing():
        for number, effect in enumerate(effects, start=1):
            if progress:
                progress(f"{number} of {len(effects)}: {effect.title}")
            blocks = tuple(_entry(effect, number=number))
            entries.append(Section(effect.key, effect.title, blocks))
    return Document(
        title="What a bench may do beyond the linear chain",
        subtitle="The catalogue of effects",
        authors=(),
        sections=(Section("summary", "Catalogue", tuple(_overview(effects))), *entries),
        footer=f"cartlab {__version__}",
    )


def _overview(effects: Sequence[Effect]) -> list[Block]:
    return [
        paragraph(_WORDS.text("effects")),
        make_table(
            1,
            _WORDS.text("effects_table"),
            ("Effect", "Where", "Parameters", "In a sentence"),
            [
                [
                    cell(Span(effect.key, "code", url=f"#{effect.key}")),
                    cell(effect.place),
                    cell(", ".join(parameter_text(p) for p in effect.parameters if p.reported)),
                    cell(effect.sentence),
                ]
                for effect in effects
            ],
            "llll",
        ),
    ]


def _entry(effect: Effect, *, number: int) -> list[Block]:
    chain = PRESETS[BENCH]
    term = usual_term(effect, chain)
    facts = [
        ("Fingerprint: ", effect.fingerprint),
        ("The run that decides: ", effect.deciding_run),
        ("Easily taken for: ", effect.equivalent),
        ("Read: ", f"{effect.reference}."),
    ]
    return [
        paragraph(effect.sentence),
        formula(from_tex(effect.equation)),
        effect_picture(term, chain, bench=BENCH, number=number),
        bullet_list(spans(Span(lead, "strong"), text) for lead, text in facts if text),
        Code(hiding_command(term)),
    ]


def effect_picture(term: Term, chain: Chain, *, bench: str, number: int) -> Picture:
    """Return an effect's fingerprint on a bench, and a run with and without it."""
    effect = term.effect
    place = f" on {effect.place} {term.place}" if term.place else ""
    alt = _WORDS.text(
        "effect_alt",
        title=effect.title,
        place=place,
        axis=effect.axis,
        fingerprint=effect.fingerprint,
    )
    caption = _WORDS.text(
        "effect",
        title=effect.title,
        place=place,
        bench=bench,
        sizes=_sizes(term),
        seen=fingerprint_words(effect),
    )
    figure = effect_figure(term, chain)
    svg = to_svg(figure, name=effect.key, alt=alt)
    return Picture(
        number=number, name=effect.key, caption=spans(caption), alt=alt, svg=svg, width=WIDTH
    )


def _sizes(term: Term) -> str:
    return ", ".join(
        f"{p.symbol} = {significant(value, digits=3)} "
        f"{p.unit_text(position=POSITION, input=INPUT)}".strip()
        for p, value in zip(term.effect.parameters, term.values, strict=True)
        if p.reported
    )


def hiding_command(term: Term) -> str:
    """Return the command that hides this effect, as in the picture."""
    place = [f"{term.effect.place}={term.place}"] if term.place else []
    pairs = zip(term.effect.parameters, term.values, strict=True)
    sizes = [f"{p.name}={value:.3g}" for p, value in pairs if p.reported]
    hide = f"{term.effect.key}:{','.join(place + sizes)}"
    return f"cartlab simulate --preset {BENCH} --hide {hide} --out bench"
