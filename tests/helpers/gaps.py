"""Plausible gaps of the two-cart bench, without a search."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.types import (
    Alternative,
    ForceAgainst,
    ForceFormula,
    FormulaTerm,
    FoundEffect,
    FreeRun,
    Gap,
    GapWindow,
    NamedValue,
    RecordGap,
    Residual,
    Trace,
    Verdict,
)
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain, EffectTerm, chain_scales
from pipeline.results import Analysis, Provenance
from pipeline.setup import Setup
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.effects import make_term

CHAIN = PRESETS["throne-2dof"]
T = np.arange(0.0, 4.0, 0.00884)
U = np.where((T > 0.1) & (T < 2.0), 0.05, 0.0)
RESIDUAL = Residual(
    cart=2,
    unit="V",
    against=(
        ForceAgainst(
            quantity="velocity", unit="cm/s", at=(-1.0, 2.0), force=(0.1, -0.4),
            spread=(0.02, None), formula=(0.1, -0.4),
        ),
    ),
    formula=ForceFormula(
        terms=(
            FormulaTerm(term="v|v|", coefficient=-0.1, std=0.01, unit="V s^2/cm^2"),
            FormulaTerm(term="|u| sign v", coefficient=0.02, std=0.001, unit="1"),
        ),
        explains=0.9,
    ),
)  # fmt: skip


def usual_terms(*keys: str) -> tuple[EffectTerm, ...]:
    """Return effects at their last place, with parameters of usual size."""
    terms = []
    for effect in map(find_effect, keys):
        place = effect.places((True, True, True))[-1]
        scales = chain_scales(CHAIN, place=effect.place, at=place, input=0.05)
        values = {p.name: p.size(scales) * p.typical for p in effect.parameters}
        terms.append(make_term(effect, place=place, values=values, chain=CHAIN))
    return tuple(terms)


def found_effects(
    terms: Sequence[EffectTerm], *, errors: Sequence[float], rivals: tuple[Alternative, ...]
) -> tuple[FoundEffect, ...]:
    """Return these effects as found one after the other; the rivals are those of the last."""
    return tuple(
        FoundEffect(
            effect=term.effect,
            where=term.where,
            parameters={
                p.name: NamedValue(
                    value=value, std=0.02 * abs(value), unit=p.unit_text(position="cm", input="V")
                )
                for p, value in zip(term.effect.parameters, term.values, strict=True)
                if p.reported
            },
            details={},
            confidence=0.6,
            nrmse_before=errors[i],
            nrmse_after=errors[i + 1],
            rivals=rivals if i + 1 == len(terms) else (),
        )
        for i, term in enumerate(terms)
    )


def make_gap(verdict: Verdict = "named", keys: Sequence[str] = ("coulomb_friction",)) -> Gap:
    """Return a plausible gap of the two-cart bench, with the traces of two steps."""
    terms = usual_terms(*keys)
    linear, model = AugmentedChain(chain=CHAIN), AugmentedChain(chain=CHAIN, terms=terms)
    rng = np.random.default_rng(7)
    before, after = (simulate_augmented(m, T, U) for m in (linear, model))
    traces = tuple(
        Trace(
            experiment=run, cart=cart, held_out=held, t=T, u=U, baseline=before[cart - 1],
            measured=after[cart - 1] + rng.normal(0.0, 0.001, T.size), final=after[cart - 1],
        )
        for run, held in (("step-a", True), ("step-b", False))
        for cart in (1, 2)
    )  # fmt: skip
    errors = np.linspace(0.153, 0.041, len(terms) + 1).tolist()
    rivals = tuple(
        Alternative(
            effect=find_effect(key), where={"cart": 2}, nrmse_after=error, confidence=confidence
        )
        for key, error, confidence in (("quadratic_drag", 0.042, 0.4), ("stiction", 0.3, 0.001))
    )
    window = GapWindow(
        experiment="step-b", cart=2, start=2.0, end=2.6, what="velocity near zero", share=0.62
    )
    return Gap(
        title="Two carts",
        bench=Setup(springs=(True, True, True)),
        provenance=Provenance(files={"data/step-a.csv": "0" * 64}),
        verdict=verdict,
        effects=found_effects(terms, errors=errors, rivals=rivals),
        baseline=0.153,
        final=errors[-1],
        noise_floor=0.03,
        repeatability=None,
        free_run=(
            FreeRun(experiment="step-a", error=0.1), FreeRun(experiment="step-b", error=None)
        ),
        residual=(RESIDUAL,) if verdict in ("partial", "unexplained") else (),
        by_record=tuple(
            RecordGap(
                experiment=t.experiment, cart=t.cart, held_out=t.held_out, baseline=0.153,
                final=0.041, noise_floor=0.03,
            )
            for t in traces
        ),
        where=(window,),
        left=() if verdict in ("none", "named") else (replace(window, share=0.31),),
        next_experiment="" if verdict == "none" else "Steps of three sizes.",
        linear=linear,
        model=model,
        training=("step-b",),
        held_out=("step-a",),
        traces=traces,
        chain_std={f"{letter}_{i}": 1e-7 for letter in "mck" for i in (1, 2)},
        spread={2: 0.05} if "coulomb_friction" in keys else {},
        notes=("no run could be spared for testing, so the last 40 % of the longest is held out",),
    )  # fmt: skip


def two_cart_analysis() -> Analysis:
    """Return an analysis whose recordings belong to the constructed gaps."""
    analysis = make_analysis(2)
    step = next(record for record in analysis.records if record.id == "step-a")
    return replace(analysis, records=(step, replace(step, id="step-b")))
