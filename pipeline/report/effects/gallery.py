"""The catalogue of effects as a page: law, picture and deciding run of each."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.effect import Effect, EffectTerm
from pipeline.report.document import Block, Code, Document, Picture, bullet_list, paragraph
from pipeline.report.effects.catalogue import INPUT, POSITION, parameter_text
from pipeline.report.effects.figures import effect_figure, scales_readings
from pipeline.report.equations.model import formula
from pipeline.report.render.builder import PageBuilder, Part
from pipeline.report.render.write import write_document
from pipeline.simulated.hidden import usual_term
from pipeline.words.numbers import significant
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import Span, spans

_WORDS = phrases("effects")
BENCH = "throne-2dof"  # the smallest preset with a spring between two carts


def render_effects(effects: Sequence[Effect], out: Path, *, progress: Progress = silent) -> None:
    """Write `effects.html` and `figures/*.svg` into `out`; repeated calls write the same bytes."""
    write_document(build_gallery(effects, progress=progress), out, name="effects", pdf=False)


def build_gallery(effects: Sequence[Effect], *, progress: Progress = silent) -> Document:
    """Return the catalogue with a picture of each effect on a simulated bench."""
    parts: list[Part] = [("summary", "Catalogue", lambda page: _overview(page, effects))]
    parts += [(e.key, e.title, lambda page, e=e: _entry(page, e)) for e in effects]
    return Document(
        title="Effects beyond the linear chain",
        subtitle="The catalogue of effects",
        authors=(),
        sections=PageBuilder().sections(parts, doing="effects", progress=progress),
    )


def _overview(page: PageBuilder, effects: Sequence[Effect]) -> list[Block]:
    rows = [
        (
            spans(Span(effect.key, "code", url=f"#{effect.key}")),
            effect.place,
            ", ".join(parameter_text(p) for p in effect.parameters if p.reported),
            effect.sentence,
        )
        for effect in effects
    ]
    return [paragraph(_WORDS.text("effects")), page.table(_WORDS, "effects_table", rows, "llll")]


def _entry(page: PageBuilder, effect: Effect) -> list[Block]:
    chain = PRESETS[BENCH]
    term = usual_term(effect, chain)
    facts = {
        "fingerprint": effect.fingerprint,
        "deciding": effect.deciding_run,
        "equivalent": effect.equivalent,
        "read": f"{effect.reference}.",
    }
    return [
        paragraph(effect.sentence),
        formula(effect.formula),
        effect_picture(page, term, chain, bench=BENCH),
        bullet_list(_WORDS.spans(f"effect_{key}", text=t) for key, t in facts.items() if t),
        Code(hiding_command(term)),
    ]


def effect_picture(page: PageBuilder, term: EffectTerm, chain: Chain, *, bench: str) -> Picture:
    """Return a picture of an effect: its fingerprint, and a run with and without it."""
    effect = term.effect
    sizes = (
        f"{p.symbol} = {significant(value, digits=3)} "
        f"{p.unit_text(position=POSITION, input=INPUT)}".strip()
        for p, value in zip(effect.parameters, term.values, strict=True)
        if p.reported
    )
    values = {
        "title": effect.title,
        "place": f" on {effect.place} {term.place}" if term.place else "",
        "bench": bench,
        "sizes": ", ".join(sizes),
        "seen": _WORDS.text("seen_reading" if scales_readings(effect) else f"seen_{effect.axis}"),
        "axis": effect.axis,
        "fingerprint": effect.fingerprint,
    }
    return page.picture(effect.key, effect_figure(term, chain), _WORDS, "effect", **values)


def hiding_command(term: EffectTerm) -> str:
    """Return the command that simulates a bench with this effect, as in the picture."""
    return f"cartlab simulate --preset {BENCH} {hiding_option(term)} --out bench"


def hiding_option(term: EffectTerm) -> str:
    """Return the option `--hide` of that command."""
    place = [f"{term.effect.place}={term.place}"] if term.place else []
    pairs = zip(term.effect.parameters, term.values, strict=True)
    sizes = [f"{p.name}={value:.3g}" for p, value in pairs if p.reported]
    return f"--hide {term.effect.key}:{','.join(place + sizes)}"
