"""Write a rubric from a reference submission, usually the instructor's own.

The shipped rubrics give the criteria, their points and the least tolerances. Kept is what the
reference's recordings can decide; wider tolerances follow from its repeats and standard errors.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from pipeline.errors import ConfigError, DataError
from pipeline.estimation.state_feedback import design_feedback
from pipeline.grading import rubric as asked
from pipeline.grading.reference import is_explained, is_linear, readings, trusted_chain
from pipeline.grading.rubric import Criterion, Rubric, matching
from pipeline.grading.rubric_file import parse_rubric, shipped_rubric
from pipeline.identify.recording_checks import find_bad_recordings
from pipeline.names import read_name
from pipeline.results import Analysis, Estimate, ExperimentKind, ParameterRow
from pipeline.submission import Experiment, Reported, Submission
from pipeline.submission.toml import TypedNumber, toml_section
from pipeline.words.numbers import listing

OUT_OF, STEP = 20, 0.25
SIGMAS = 3.0  # standard errors, or standard deviations of repeats, that cost no points
# Percent: a number whose error is larger cannot be judged.
_UNKNOWN, _UNKNOWN_DAMPING = 50.0, 150.0
_MOST_PERCENT = 1000.0  # the largest tolerance that a rubric may have
_HARDWARE_SLACK = 1.5  # the model of a student may be this much worse than the reference's
_EVIDENCE: dict[ExperimentKind, tuple[str, str]] = {  # kinds that a fit can rest on, best first
    "sine": ("dwells", "the sine dwells"),
    "bode": ("bode-table", "the Bode table"),
    "sweep": ("sweeps", "the sweeps"),
    "step": ("steps", "the steps"),
}
_READ = ("step", "log_decrement")  # sources of first estimates that are not read by eye
_LIMITS = tuple(f"{of}{limit}_percent" for of in ("", "damping_") for limit in ("full", "none"))
_IN_ORDER = (
    *("id", "title", "points", "check", "experiments", "parameters", *_LIMITS),
    *("requires", "message"),
)
_FIRST_LINES = """\
# Written by `cartlab new-rubric` from {source}. Change what your lab asks for differently.
# rubrics/README.md explains every key; `cartlab check-rubric FILE --from DIR` shows what simulated
# students would get.
"""


@dataclass(frozen=True, kw_only=True)
class NewRubric:
    """A rubric that was written from a reference submission.

    Attributes
    ----------
    text : the file, with comments.
    undecided : what the shipped rubrics ask for and the recordings cannot decide, and why.
    """

    text: str
    rubric: Rubric
    undecided: tuple[str, ...]


def new_rubric(submission: Submission, analysis: Analysis, *, source: str) -> NewRubric:
    """Return the rubric for a class that measures what the reference measured.

    If the reference has `[reported]`, its numbers are those that students hand in. Otherwise,
    students hand in everything that the recordings can decide.

    Parameters
    ----------
    source : name of the reference in the rubric's first comment.

    Raises
    ------
    ConfigError : the recordings decide none of the numbers.
    """
    draft = _Draft(submission, analysis)
    if not draft.names["initial"] and not draft.names["final"]:
        raise ConfigError(
            f"{source}: its recordings decide no number that students could report; "
            f"`cartlab report {source}` says what is missing"
        )
    criteria = list(draft.criteria())
    points = share_points([one.points for one, _ in criteria], out_of=OUT_OF, step=STEP)
    text = _FIRST_LINES.format(source=source) + "\n".join(draft.head())
    for (criterion, comment), own in zip(criteria, points, strict=True):
        table = criterion.model_copy(update={"points": own}).model_dump(exclude_unset=True)
        table = {key: table[key] for key in _IN_ORDER if table.get(key, ()) != ()}
        heading = f"[[criteria]]{f'  # {comment}' if comment else ''}"
        text += "\n" + toml_section(heading, _typed(table))
    return NewRubric(
        text=text,
        rubric=parse_rubric(text, where="new rubric"),
        undecided=tuple(
            f"{', '.join(what for what, own in draft.undecided.items() if own == why)}: {why}"
            for why in dict.fromkeys(draft.undecided.values())
        ),
    )


def share_points(weights: Sequence[float], *, out_of: float, step: float) -> list[float]:
    """Return points in proportion to weights, in multiples of `step`, that sum to `out_of`.

    Each weight gets at least one step. The steps that rounding leaves go to the largest remainders.
    """
    steps = round(out_of / step)
    exact = [weight * steps / sum(weights) for weight in weights]
    given = [max(1, math.floor(one)) for one in exact]
    while (left := steps - sum(given)) != 0:
        sign = int(math.copysign(1, left))
        free = [i for i, one in enumerate(given) if sign > 0 or one > 1]
        given[max(free, key=lambda i: sign * (exact[i] - given[i]))] += sign
    return [one * step for one in given]


class _Draft:
    """The parts of a new rubric.

    Attributes
    ----------
    names : the numbers of each table that students hand in.
    undecided : what is left out, and why.
    """

    def __init__(self, submission: Submission, analysis: Analysis) -> None:
        n = submission.system.carts
        shipped = shipped_rubric(n) or shipped_rubric(3)
        assert shipped is not None
        self._submission, self._analysis, self._shipped = submission, analysis, shipped
        self._all = [row.name for row in analysis.rows]
        self._rows = {row.name: row for row in analysis.rows}
        self._chain = trusted_chain(analysis)
        bad = find_bad_recordings(analysis)
        unusable = {*bad, *analysis.unreadable}
        self._runs = [one for one in submission.used if one.id not in unusable]
        kinds = {run.kind for run in self._runs}
        self._evidence: ExperimentKind | None = next(
            (kind for kind in _EVIDENCE if kind in kinds), None
        )
        self.undecided: dict[str, str] = {}
        own = submission.reported or Reported(
            initial=dict.fromkeys(self._all, Decimal()), final=dict.fromkeys(self._all, Decimal())
        )
        self.names = {
            "initial": [x for x in self._all if x in own.initial and self._is_known(x, "initial")],
            "final": [x for x in self._all if x in own.final and self._is_known(x, "final")],
        }
        silent = submission.reported is None
        has_model = self._chain is not None and self.names["final"] != []
        self._state_space = has_model and (silent or own.state_space is not None)
        wanted = [x for x in shipped.required.feedback if silent or getattr(own.feedback, x, None)]
        why = self._unreachable() if has_model else "the recordings give no model"
        if wanted and why:
            self.undecided["feedback"] = why
        self._feedback = [] if why else wanted

    # ------------------------------------------------------------- what the recordings decide

    def _estimate(self, name: str, table: str) -> Estimate | None:
        row = self._rows[name]
        found = row.initial if table == "initial" else row.final
        if found is None or found.at_bound or (found.source == "assumed" and table == "final"):
            return None
        return found

    def _is_known(self, name: str, table: str) -> bool:
        """Return whether the recordings decide a number; if not, note why."""
        found = self._estimate(name, table)
        if found is None or (table == "final" and self._chain is None):
            why = "the recordings give no value"
        elif table == "final" and self._rows[name].extrapolated:
            why = "no measurement is near it"
        elif table == "initial" and not read_name(name).is_by_eye and found.source not in _READ:
            why = "no step or decay shows it"
        elif found.source != "assumed" and self._scatter(name, table) * SIGMAS > _most(name):
            why = f"its standard error is {self._scatter(name, table):.0f} %"
        else:
            return True
        self.undecided[f"{table} {name}"] = why
        return False

    def _scatter(self, name: str, table: str) -> float:
        """Return the error of a number in percent: of one reading among repeats, or of the fit."""
        found = self._estimate(name, table)
        if found is None or found.source == "assumed" or found.value == 0:
            return 0.0
        std = found.std or 0.0
        if table == "initial" and len(read := readings(name, self._analysis)) > 1:
            std = max(std, float(np.std(read, ddof=1)))
        return 100 * std / abs(found.value)

    def _unreachable(self) -> str:
        """Return why no state feedback can be designed for the reference; "" if one can."""
        if self._submission.design is None:
            return "submission.toml has no [design], so no goal is known"
        assert self._chain is not None
        try:
            design = design_feedback(self._chain, self._submission.design)
        except DataError as error:
            return str(error)
        return "" if design.reachable else f"the goal of [design] is out of reach: {design.message}"

    # ------------------------------------------------------------------------------- tables

    def head(self) -> Iterator[str]:
        """Yield the tables before the criteria."""
        of, system = self._submission, self._submission.system
        yield toml_section("", {"version": 1, "title": of.title, "step": STEP})
        bench = system.model_dump(exclude_none=True)
        if not system.states_springs:
            del bench["springs"]
        yield toml_section(
            "[system]", _typed({key: one for key, one in bench.items() if one != {}})
        )
        if self._feedback and of.design is not None:
            yield toml_section("[design]", _typed(of.design.model_dump(exclude_none=True)))
        required: dict[str, Any] = {
            table: _patterns(names, self._all) for table, names in self.names.items() if names
        }
        if self._state_space:
            required["state_space"] = True
        if self._feedback:
            required["feedback"] = self._feedback
        yield toml_section("[required]", _typed(required))
        for runs in self._required_runs():
            yield toml_section("[[required.experiments]]", _typed(runs))
        costs = self._shipped.flags.model_dump(exclude_unset=True)
        kept = {
            code: cost for code, cost in costs.items() if self._state_space or "space" not in code
        }
        heading = "[flags]  # a remark costs at least this share of its criterion's points"
        yield toml_section(heading, kept)

    def _required_runs(self) -> Iterator[dict[str, Any]]:
        """Yield the recordings to hand in: of each sort half as many as the reference has.

        Other recordings that a fit can rest on are optional if there are better ones.
        """
        optional = set(_EVIDENCE) - {self._evidence, "step"}
        groups: dict[tuple[ExperimentKind, tuple[int, ...]], list[Experiment]] = {}
        for run in self._runs:
            if run.kind not in optional and (
                run.kind != "closed_loop" or self._nrmse() is not None
            ):
                groups.setdefault((run.kind, run.carts), []).append(run)
        everyone = tuple(range(1, self._submission.system.carts + 1))
        alone = {carts for kind, carts in groups if kind == "decay"}
        for (kind, carts), runs in groups.items():
            if kind == "step" and carts != everyone and carts in alone:
                continue  # a step of one cart alone counts as its decay
            few = max(1, len(runs) // 2)
            of = {} if carts == everyone and kind != "decay" else {"carts": carts}
            yield {"kind": kind, **of, **({"at_least": few} if few > 1 else {})}

    def _nrmse(self) -> float | None:
        """Return the least difference of a closed loop from its simulation, in percent."""
        runs: dict[str, list[float]] = {}
        for check in self._analysis.hardware:
            if check.loop == "closed" and not check.contradicted:
                runs.setdefault(check.experiment, []).append(check.nrmse)
        return min(
            (100 * float(np.sqrt(np.mean(np.square(e)))) for e in runs.values()), default=None
        )

    # ----------------------------------------------------------------------------- criteria

    def criteria(self) -> Iterator[tuple[Criterion, str]]:
        """Yield the criteria of the shipped rubric that the recordings decide, with comments."""
        kept: set[str] = set()
        for one in self._shipped.criteria:
            found = self._adapted(one)
            if found is None:
                continue
            criterion, comment = found
            requires = tuple(self._renamed(id_) for id_ in one.requires)
            requires = tuple(id_ for id_ in requires if id_ in kept)
            kept.add(criterion.id)
            yield criterion.model_copy(update={"requires": requires}), comment
        if not is_explained(self._analysis):
            yield (
                asked.Manual(
                    id="gap",
                    title="what the linear model leaves out",
                    points=2.0,
                    check="manual",
                    message="Name what the linear model lacks, and the recording that shows it.",
                ),
                "a linear chain does not explain the reference's recordings",
            )

    def _renamed(self, id_: str) -> str:
        """Return the id of a criterion; that of the dwells depends on what the fit rests on."""
        return _EVIDENCE[self._evidence][0] if id_ == "dwells" and self._evidence else id_

    def _adapted(self, one: Criterion) -> tuple[Criterion, str] | None:
        """Return a criterion of the shipped rubric with the reference's numbers, and a comment."""
        match one:
            case asked.RequiredPieces(experiments=()) | asked.DataQuality():
                return one, ""
            case asked.RequiredPieces():
                if self._evidence is None or not self.names["final"]:
                    return None
                id_, title = _EVIDENCE[self._evidence]
                update = {"id": id_, "title": title, "experiments": (self._evidence,)}
                return one.model_copy(update=update), ""
            case asked.Parameters():
                return self._of_table(one)
            case asked.InitialFinal():
                return self._comparison(one)
            case asked.Laws():
                complete = self.names["final"] == self._all and is_linear(self._analysis)
                return (one, "") if complete else None
            case asked.StateModel():
                return (one, "") if self._state_space else None
            case asked.Hardware():
                if (nrmse := self._nrmse()) is None:
                    return None
                limits = _limits(one, _HARDWARE_SLACK * nrmse)
                return one.model_copy(update=limits), f"the reference differs by {_percent(nrmse)}"
            case asked.Claims():
                claims = {"overshoot_percent", "settling_time"}
                return None if claims.isdisjoint(self._feedback) else (one, "")
        return (one, "") if one.check in self._feedback else None  # gains and prefilter

    def _of_table(self, one: asked.Parameters) -> tuple[Criterion, str] | None:
        sorts = {_sort(name) for name in matching(one.parameters, self._shipped.names)}
        names = [name for name in self.names[one.check] if _sort(name) in sorts]
        if not names:
            return None
        update: dict[str, Any] = {"parameters": _patterns(names, self._all)}
        title = one.title if self._evidence in ("sine", "bode") else one.title.replace("Bode ", "")
        update["title"] = title if names != ["mass"] else "mass from the fit"
        said = []
        for damping in (False, True):
            own = [x for x in names if read_name(x).is_damping == damping]
            scatter = max((self._scatter(x, one.check) for x in own), default=0.0)
            if own:
                update |= _limits(one, SIGMAS * scatter, prefix="damping_" if damping else "")
                said.append(f"{_percent(scatter)}{' for dampings' if damping else ''}")
        what = (
            "scatter of the reference's readings" if one.check == "initial" else "standard errors"
        )
        return one.model_copy(update=update), f"{what}: {listing(said)}"

    def _comparison(self, one: asked.InitialFinal) -> tuple[Criterion, str] | None:
        both = [x for x in self.names["final"] if x in self.names["initial"]]
        if not both:
            return None
        update: dict[str, Any] = {"parameters": _patterns(both, self._all)}
        for damping in (False, True):
            rows = [self._rows[x] for x in both if read_name(x).is_damping == damping]
            if rows:
                apart = max(map(_apart, rows))
                update |= _limits(one, apart, prefix="damping_" if damping else "")
        return one.model_copy(update=update), ""


def _sort(name: str) -> tuple[str, bool]:
    """Return the sort of a number; criteria of the shipped rubrics judge whole sorts."""
    read = read_name(name)
    symbol = {"mass": "K", "damping": "zeta"}.get(read.symbol, read.symbol)
    return symbol, read.is_by_eye


def _apart(row: ParameterRow) -> float:
    """Return the difference of both estimates in percent, as a factor; 0 for a guess."""
    first, last = row.initial, row.final
    if first is None or last is None or first.source == "assumed" or first.value * last.value <= 0:
        return 0.0
    return 100 * math.expm1(abs(math.log(first.value / last.value)))


def _percent(value: float) -> str:
    return f"{value:.2g} %" if value >= 0.1 else "below 0.1 %"


def _most(name: str) -> float:
    return _UNKNOWN_DAMPING if read_name(name).is_damping else _UNKNOWN


def _limits(one: Criterion, percent: float, *, prefix: str = "") -> dict[str, float]:
    """Return the limits of a criterion, wider if `percent` is more than its own.

    Wider limits are multiples of 5 %, and their ratio stays.
    """
    full, none = (getattr(one, f"{prefix}{name}_percent") for name in ("full", "none"))
    wide = (
        min(5.0 * math.ceil(percent / 5), _MOST_PERCENT * full / none) if percent > full else full
    )
    return {f"{prefix}full_percent": wide, f"{prefix}none_percent": wide * none / full}


def _patterns(names: Sequence[str], every: Sequence[str]) -> tuple[str, ...]:
    """Return names as patterns where all names of a sort are asked for: `*`, `K_*`."""
    if list(names) == list(every):
        return ("*",)
    found: list[str] = []
    for name in names:
        pattern = f"{read_name(name).symbol}_*"
        alike = matching((pattern,), list(every))
        is_all = len(alike) > 1 and set(alike) <= set(names)
        found.append(pattern if is_all else name)
    return tuple(dict.fromkeys(found))


def _typed(value: Any) -> Any:
    """Return a value or a table whose numbers are written without superfluous digits."""
    if isinstance(value, float):
        return TypedNumber(f"{value:.10g}")
    if isinstance(value, Mapping):
        return {key: _typed(one) for key, one in value.items()}
    return [_typed(one) for one in value] if isinstance(value, list | tuple) else value
