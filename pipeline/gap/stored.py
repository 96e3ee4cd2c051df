"""`gap.json` as a file: written with the model's units and the data's hashes, and read back."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.gap.document import gap_json
from pipeline.gap.types import (
    Contender,
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
    Rival,
)
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects import AugmentedChain, Term, find_effect
from pipeline.results import Analysis, LeftOut
from pipeline.results_json import chain_entry, provenance
from pipeline.results_of_runs import Intervention
from pipeline.schemas.base import fields_of, json_text
from pipeline.schemas.gap import Gap as GapDocument
from pipeline.schemas.gap import GapSubmission
from pipeline.submission.complaints import quote, refusal


def gap_text(gap: Gap, analysis: Analysis) -> str:
    """Return `gap.json` as text, numbers at ten significant digits: same input, same bytes."""
    position, drive = analysis.position_unit, analysis.input_unit
    document = gap_json(gap, position_unit=position, input_unit=drive) | {
        "submission": fields_of(GapSubmission, analysis),
        "springs": analysis.springs,
        "chain": chain_entry(gap.model.chain, position=position, drive=drive),
        "chain_std": gap.chain_std,
        "provenance": provenance(analysis),
    }
    return json_text(document)


def read_gap(text: str) -> tuple[Gap, dict[str, str]]:
    """Return the gap, without its traces, and the SHA-256 of each data file it is about.

    Raises
    ------
    ConfigError : the text is no `gap.json`, or its model is not of this catalogue.
    """
    try:
        document = GapDocument.model_validate_json(text).model_dump(by_alias=True)
        return _gap(document), dict(document["provenance"]["files"])
    except ValidationError as error:
        first = error.errors()[0]
        at = ".".join(map(str, first["loc"]))
        what = f"{at}: {refusal(first)}" if at else refusal(first)
        raise ConfigError(f"not what cartlab gap writes: {what}") from None
    except (ValueError, KeyError, TypeError) as error:  # null where a number is needed, say
        raise ConfigError(f"not what cartlab gap writes: {quote(str(error))}") from None


def _gap(document: Mapping[str, Any]) -> Gap:
    errors = document["gap"]
    return Gap(
        verdict=document["verdict"],
        effects=tuple(_effect(entry) for entry in document["effects"]),
        baseline=float(errors["baseline"]),
        final=float(errors["final"]),
        noise_floor=float(errors["noise_floor"]),
        repeatability=_or_none(document["repeatability"]),
        by_record=tuple(RecordGap(**entry) for entry in document["by_record"]),
        where=tuple(_window(entry) for entry in document["where"]),
        free_run=tuple(FreeRun(**entry) for entry in document["free_run"]),
        residual=tuple(_residual(entry) for entry in document["residual"]),
        next_experiment=str(document["next_experiment"]),
        linear=AugmentedChain(chain=_chain(document["linear"])),
        model=_model(document["model"]),
        training=tuple(document["training"]),
        held_out=tuple(document["held_out"]),
        left_out=tuple(LeftOut(**entry) for entry in document["left_out"]),
        interventions=tuple(_intervention(entry) for entry in document["interventions"]),
        traces=(),
        chain_std=dict(document["chain_std"]),
        spread={int(cart): value for cart, value in document["friction_spread"].items()},
        suspects=tuple(_rival(entry) for entry in document["suspects"]),
        left=tuple(_window(entry) for entry in document["left"]),
        complete=document["complete"],
        notes=tuple(document["notes"]),
        contenders=tuple(
            Contender(model=_model(entry), weight=float(entry["weight"]))
            for entry in document["contenders"]
        ),
    )


def _model(entry: Mapping[str, Any]) -> AugmentedChain:
    return AugmentedChain(
        chain=_chain(entry["chain"]), terms=tuple(_term(term) for term in entry["effects"])
    )


def _effect(entry: Mapping[str, Any]) -> FoundEffect:
    return FoundEffect(
        effect=find_effect(entry["effect"]),
        where=dict(entry["where"]),
        parameters=_values(entry["parameters"]),
        details=_values(entry["details"]),
        confidence=float(entry["confidence"]),
        nrmse_before=float(entry["nrmse_before"]),
        nrmse_after=float(entry["nrmse_after"]),
        rivals=tuple(_rival(rival) for rival in entry["rivals"]),
    )


def _window(entry: Mapping[str, Any]) -> GapWindow:
    return GapWindow(
        experiment=entry["experiment"],
        cart=entry["cart"],
        start=entry["from"],
        end=entry["to"],
        what=entry["what"],
        share=entry["share"],
    )


def _intervention(entry: Mapping[str, Any]) -> Intervention:
    return Intervention(
        experiment=entry["experiment"],
        cart=entry["cart"],
        start=entry["from"],
        end=entry["to"],
        what=entry["what"],
    )


def _residual(entry: Mapping[str, Any]) -> Residual:
    formula = entry["formula"]
    return Residual(
        cart=entry["cart"],
        unit=entry["unit"],
        against=tuple(ForceAgainst(**one) for one in entry["against"]),
        formula=None
        if formula is None
        else ForceFormula(
            terms=tuple(FormulaTerm(**term) for term in formula["terms"]),
            explains=formula["explains"],
        ),
    )


def _rival(entry: Mapping[str, Any]) -> Rival:
    return Rival(
        effect=find_effect(entry["effect"]),
        where=dict(entry["where"]),
        nrmse_after=float(entry["nrmse_after"]),
        confidence=float(entry["confidence"]),
    )


def _values(entries: Mapping[str, Any]) -> dict[str, NamedValue]:
    return {
        name: NamedValue(
            value=float(entry["value"]), std=_or_none(entry["std"]), unit=str(entry["unit"])
        )
        for name, entry in entries.items()
    }


def _or_none(value: Any) -> float | None:
    return None if value is None else float(value)


def _term(entry: Mapping[str, Any]) -> Term:
    effect = find_effect(entry["effect"])
    values = tuple(float(entry["parameters"][name]) for name in effect.names)
    return Term(effect=effect, place=int(next(iter(entry["where"].values()), 0)), values=values)


def _chain(entry: Mapping[str, Any]) -> Chain:
    return Chain(m=np.array(entry["m"]), c=np.array(entry["c"]), k=np.array(entry["k"]))
