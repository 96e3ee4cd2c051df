"""Give a hint about a wrong number: the kind of mistake, and the part of a recording that shows it.

A hint must not reveal a value. There are only six parts of a recording, so a part does not reveal a
period or a settling time. All sine dwells are named together, because the one nearest to a
resonance would reveal its frequency.
"""

from collections.abc import Iterator, Sequence
from typing import get_args

from pipeline.grading.grade import CODES, Flag
from pipeline.grading.judge.context import GradingContext
from pipeline.grading.self_check.log import Hint, MistakeKind, Part, RecordingPart
from pipeline.names import read_name
from pipeline.results import Analysis, ExperimentKind

_TABLES = ("initial", "final")
# Mistakes in reading a decay or a step. If a final table has one, the hint names decays and steps.
_OF_TIME_RECORDS: tuple[MistakeKind, ...] = ("peak_count", "log10_for_ln", "peak_for_steady_state")
# Mistakes that no part of a recording can show.
_OF_NO_RECORD: tuple[MistakeKind, ...] = ("physically_impossible", "no_fit_done")
_IN_FREQUENCY: tuple[ExperimentKind, ...] = ("sine", "sweep", "bode")
_OF_LOOP: dict[str, MistakeKind] = {
    "gains": "wrong_gains",
    "prefilter": "wrong_prefilter",
    "overshoot_percent": "claims_off",
    "settling_time": "claims_off",
}


def find_hint(number: str, context: GradingContext, flags: Sequence[Flag]) -> Hint:
    """Return a hint for a number that disagrees.

    Parameters
    ----------
    number : key of the number under `[reported]`, such as "final.K_1".
    flags : all flags of the submission, in the order of `CODES`.
    """
    table, _, name = number.partition(".")
    if table == "feedback":
        return Hint(number=number, slip=_OF_LOOP[name])
    if table == "state_space":
        return Hint(number=number, slip="wrong_state_space")
    slip, or_else = _find_slip(table, name, flags)
    return Hint(
        number=number,
        slip=slip,
        or_else=or_else,
        stretches=tuple(_find_stretches(table, name, slip, context.analysis)),
    )


def _find_slip(
    table: str, name: str, flags: Sequence[Flag]
) -> tuple[MistakeKind, tuple[MistakeKind, ...]]:
    mine = [flag for flag in flags if _is_about(flag, table, name)]
    # A mistake in one table is a better hint than a difference between the tables.
    mine.sort(key=lambda flag: flag.code == "initial_final_disagree")
    if not mine:
        return ("initial_off" if table == "initial" else "final_off"), ()
    others = mine[0].evidence.get("or_else", ())
    return mine[0].code, tuple(code for code in CODES if code in others)


def _is_about(flag: Flag, table: str, name: str) -> bool:
    if name not in flag.parameters:
        return False
    tables = {flag.evidence.get("table"), flag.evidence.get("also_in")}
    return table in tables or flag.code == "initial_final_disagree"


def _find_stretches(
    table: str, name: str, slip: MistakeKind, analysis: Analysis
) -> Iterator[RecordingPart]:
    """Yield the parts of recordings in which a mistake in a number can be seen."""
    if slip in _OF_NO_RECORD:
        return
    if table == "initial" or slip in _OF_TIME_RECORDS:
        own = list(_list_readings(name, analysis))
        if own:
            yield from _gather(own)
            return
    part: Part = "beginning" if slip == "transient_used" else "whole"
    kinds = _find_kinds(analysis)
    every: list[tuple[str, ExperimentKind, Part]] = [
        (run, kind, part) for run, kind in kinds.items()
    ]
    yield from _gather([one for one in every if one[1] in _IN_FREQUENCY] or every)


def _list_readings(name: str, analysis: Analysis) -> Iterator[tuple[str, ExperimentKind, Part]]:
    """Yield experiment, kind and part of each recording from which a first estimate is read."""
    read = read_name(name)
    if read.is_by_eye and read.suffix != "n":
        return
    cart = read.cart or 1
    if read.is_gain:
        for step in analysis.step_gains:
            if step.cart == cart and step.edges:
                window = step.edges[0].window_after
                yield step.experiment, "step", _name_part(step.experiment, window, analysis)
    else:
        kinds = _find_kinds(analysis)
        for decay in analysis.log_decrements:
            if decay.cart == cart:
                window = decay.release, float(decay.peak_t[-1])
                run = decay.experiment
                yield run, kinds.get(run, "decay"), _name_part(run, window, analysis)


def _find_kinds(analysis: Analysis) -> dict[str, ExperimentKind]:
    """Return the kind of every recording, and of each table that the students reduced."""
    kinds: dict[str, ExperimentKind] = {}
    for response in analysis.frequency_responses:
        kinds |= dict.fromkeys(response.experiments, "bode")
    for record in analysis.records:
        kinds[record.id] = record.kind
    return kinds


def _name_part(run: str, window: tuple[float, float], analysis: Analysis) -> Part:
    """Return the smallest of the six parts of a recording that contains a window of time."""
    record = next((one for one in analysis.records if one.id == run), None)
    if record is None:
        return "whole"
    length = float(record.t[-1] - record.t[0])
    start, end = ((float(t) - float(record.t[0])) / length for t in window)
    if end <= 0.3:
        return "beginning"
    if start >= 0.7:
        return "end"
    if end <= 0.55:
        return "first_half"
    if start >= 0.45:
        return "second_half"
    return "middle" if start >= 0.2 and end <= 0.8 else "whole"


def _gather(parts: Sequence[tuple[str, ExperimentKind, Part]]) -> Iterator[RecordingPart]:
    """Yield the parts; recordings of the same kind and part are named together."""
    order = [(kind, part) for kind in get_args(ExperimentKind) for part in get_args(Part)]
    for kind, part in order:
        runs = tuple(dict.fromkeys(run for run, k, p in parts if (k, p) == (kind, part)))
        if runs:
            yield RecordingPart(kind=kind, recordings=runs, part=part)
