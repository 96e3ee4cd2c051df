"""The input to the checks, and their results (verdicts)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

from pipeline.arrays import Array
from pipeline.grading.grade import Flag
from pipeline.grading.mistakes.controller import Controller
from pipeline.grading.mistakes.explain import Label
from pipeline.grading.mistakes.state_model import MatrixEntry, Order, StateMatrices, compare_entries
from pipeline.grading.mistakes.undo import Number, Slip, Slipped, all_slips, undo
from pipeline.grading.reference import References, readings
from pipeline.grading.rubric import RequiredPieces, RequiredRuns, Rubric, matching
from pipeline.grading.tolerance import ALL, NONE, Deviation, mean_share
from pipeline.names import read_name
from pipeline.plant.effect import EffectTerm
from pipeline.results import Analysis, ExperimentKind, Finding
from pipeline.submission import (
    Experiment,
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    Submission,
)
from pipeline.words.numbers import first_few
from pipeline.words.text import sentence


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A required item: a typed number, or recordings of one kind.

    Attributes
    ----------
    name : name in flags, such as "decay of cart 2", "12 sine" or "final.K_1".
    text : the item in words, such as "decay of cart 2" or "12 sine dwells".
    kind : kind of recording; None for a typed number.
    """

    name: str
    text: str
    kind: ExperimentKind | None = None
    there: int = 0
    needed: int = 1

    @property
    def share(self) -> Fraction:
        """The share that is there."""
        return Fraction(min(self.there, self.needed), self.needed)


# The checks whose result depends on numbers of the tables, or on the gains.
_OF_TABLES: Mapping[str, tuple[Label, ...]] = {
    "initial": ("initial",),
    "final": ("final",),
    "initial_final": ("initial", "final"),
    "laws": ("final",),
}
_GAINS = Slip(code="wrong_gains")


@dataclass(frozen=True, kw_only=True)
class GradingContext:
    """Everything that a check may use.

    Attributes
    ----------
    references : the parameters from the recordings, with bounds.
    controller : the reported controller, with the models to simulate it on.
    state_models : acceptable values of [A B].
    bad : recordings with a problem, and the first problem of each.
    named : for each table, the parameters whose errors a known mistake explains.
    slipped : for each table, what mistakes did to its numbers.
    meant : the gains that were meant, if a known mistake explains the reported ones, shape (2n,).
    order : the order of the states in which A and B are meant.
    gains_order : the order in which the gains are meant, if it is not x1, v1, x2, v2, …
    effects : the effects of the team's bench in an answer key; None if they are not known.
    left : the mistakes that are left in the numbers; None for all, so that numbers are as typed.
    """

    submission: Submission
    analysis: Analysis
    rubric: Rubric
    references: References
    controller: Controller | None
    state_models: Sequence[StateMatrices]
    bad: Mapping[str, Finding]
    named: Mapping[Label, frozenset[str]]
    slipped: Mapping[Label, Sequence[Slipped]]
    order: Order
    gains_order: Order | None = None
    meant: Array | None = None
    effects: Sequence[EffectTerm] | None = None
    left: Collection[Slip] | None = None

    def numbers(self, label: Label) -> dict[str, Number]:
        """Return the numbers of a table, as typed or with mistakes undone."""
        changes = () if self.left is None else self.slipped[label]
        return undo(getattr(self.reported, label), changes, left=self.left or ())

    def slips(self, check: str) -> list[Slip]:
        """Return the mistakes that may cost points in a check and can be undone."""
        if check in ("gains", "claims", "prefilter"):
            return [_GAINS] if self.meant is not None else []
        labels = _OF_TABLES.get(check, ())
        return list(all_slips([one for label in labels for one in self.slipped[label]]))

    def leaving(self, left: Collection[Slip]) -> "GradingContext":
        """Return the input with all mistakes undone, except those that are left."""
        controller = self.controller
        if controller is not None and self.meant is not None and _GAINS not in left:
            controller = replace(controller, gains=self.meant)
        return replace(self, left=left, controller=controller)

    @cached_property
    def pieces(self) -> list[Piece]:
        """The required items; an unreadable file counts as missing."""
        return find_pieces(self.submission, self.rubric, unreadable=self.analysis.unreadable)

    @property
    def problems(self) -> dict[str, str]:
        """The recordings with a problem, each with its problem in words."""
        return {run: finding.reason for run, finding in self.bad.items()}

    @property
    def missing(self) -> list[Piece]:
        """The required items that are missing, wholly or in part."""
        return [piece for piece in self.pieces if piece.share < 1]

    @cached_property
    def entries(self) -> list[MatrixEntry]:
        """The reported entries of A and B with their acceptable values.

        Empty if A is not reported.
        """
        return self.entries_from(self.state_models)

    def models_from(self, source: str) -> Sequence[StateMatrices]:
        """Return the acceptable [A B] of one source: "own", "recordings" or "either"."""
        every = self.state_models
        return [m for m in every if source == "either" or m.own == (source == "own")]

    def entries_from(self, models: Sequence[StateMatrices]) -> list[MatrixEntry]:
        """Return the reported entries of A and B with the values that some models accept."""
        space, n = self.reported.state_space, self.rubric.system.carts
        if space is None or not space.A:
            return []
        return compare_entries(space, models=models, n=n, order=self.order)

    @property
    def reported(self) -> Reported:
        """The reported numbers; empty if nothing is reported."""
        return self.submission.reported or Reported()

    def why_unread(self, *at: str) -> str:
        """Return why a number of `[reported]`, or its whole table, cannot be read; else ""."""
        parts = {one.at[1:]: one.message for one in self.submission.unread}
        return next((parts[at[:n]] for n in range(len(at) + 1) if at[:n] in parts), "")

    @property
    def omits_final(self) -> bool:
        """Whether the final table lacks more numbers than it has that cannot be read."""
        lacking = set(self.rubric.names) - set(self.reported.final)
        unread = [one for one in self.submission.unread if one.at[1:2] == ("final",)]
        return len(lacking) > len(unread)

    @property
    def strange(self) -> list[str]:
        """The messages on parts of `[reported]` with a name that no table has, such as `K1`."""
        names = self.rubric.names
        known = {"initial": names, "final": names}
        known |= {"state_space": [*ReportedStateSpace.model_fields]}
        known |= {"feedback": [*ReportedFeedback.model_fields]}
        return [
            one.message
            for one in self.submission.unread
            for table, *below in [one.at[1:]] * (len(one.at) > 1)
            if table not in known or (below and below[0] not in known[table])
        ]

    def because_unread(self, *at: str) -> str:
        """Return the reason as a further sentence, with a space before it; "" without a reason."""
        why = self.why_unread(*at)
        return f" Cannot be read: {sentence(why)}" if why else ""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of a check: a share of the points and a message.

    Attributes
    ----------
    share : share of the points; None if nothing could be judged; `message` then says why.
    explained : whether a known mistake explains all lost points; its flag then replaces the
        rubric's advice.
    models : for each acceptable model, the errors of the numbers; the best model counts. Empty if
        the share does not depend on tolerances.
    most : the largest possible share, whatever the tolerances.
    agrees : for each number that is judged by itself, whether it earns all its points.
    """

    share: Fraction | None
    message: str
    expected: dict[str, Any] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)
    explained: bool = False
    models: tuple[tuple[Deviation, ...], ...] = ()
    most: Fraction = ALL
    agrees: Mapping[str, bool] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The verdicts on one criterion: as typed, and with mistakes undone.

    Attributes
    ----------
    undone : the verdict with all mistakes undone.
    only : for each mistake that matters here, the verdict with all other mistakes undone.
    """

    typed: Verdict
    undone: Verdict
    only: Mapping[Slip, Verdict] = field(default_factory=dict)

    @property
    def is_better_undone(self) -> bool:
        """Whether undoing the mistakes earns more points than the numbers as typed."""
        return (self.undone.share or NONE) > (self.typed.share or NONE)

    @classmethod
    def plain(cls, verdict: Verdict) -> "Judgement":
        """Return a judgement in which no mistake can be undone."""
        return cls(typed=verdict, undone=verdict)


# --------------------------------------------------------------------- required items

# Kinds of recording that meet a requirement for only some of the carts. A step also counts as a
# decay, because the carts ring down after it.
_SERVES = {"decay": ("decay", "step"), "sine": ("sine",), "step": ("step",)}
_RECORDING = {"sine": "sine dwell", "closed_loop": "closed-loop recording", "bode": "Bode table"}


def find_pieces(
    submission: Submission, rubric: Rubric, *, unreadable: Collection[str] = ()
) -> list[Piece]:
    """Return all items that a rubric requires, and how much of each is in a submission.

    An experiment whose file cannot be read counts as missing.
    """
    required, reported = rubric.required, submission.reported or Reported()
    left = [e for e in submission.experiments if e.id not in unreadable]
    found = [_recordings(runs, left, carts=rubric.system.carts) for runs in required.experiments]
    typed: dict[str, bool] = {}
    for label in ("initial", "final"):
        for name in matching(getattr(required, label), rubric.names):
            typed[f"{label}.{name}"] = name in getattr(reported, label)
    if required.state_space:
        space = reported.state_space or ReportedStateSpace()
        typed |= {"state_space.A": bool(space.A), "state_space.B": bool(space.B)}
    for name in required.feedback:
        typed[f"feedback.{name}"] = getattr(reported.feedback, name, None) not in (None, ())
    return found + [Piece(name=n, text=n, there=int(there)) for n, there in typed.items()]


def pieces_for(criterion: RequiredPieces, pieces: Sequence[Piece], rubric: Rubric) -> list[Piece]:
    """Return the items that one criterion judges.

    These are the recordings of its own kinds. A criterion without kinds judges every item that no
    other criterion names.
    """
    if criterion.experiments:
        return [piece for piece in pieces if piece.kind in criterion.experiments]
    others = [c.experiments for c in rubric.criteria if isinstance(c, RequiredPieces)]
    named = {kind for kinds in others for kind in kinds}
    return [piece for piece in pieces if piece.kind not in named]


def share_there(pieces: Sequence[Piece]) -> Fraction:
    """Return the share of items that are there; recordings count as much as typed numbers do."""
    groups = [
        [piece.share for piece in pieces if (piece.kind is None) == typed]
        for typed in (True, False)
    ]
    return mean_share([mean_share(group) for group in groups if group])


def say_missing(pieces: Sequence[Piece], *, most: int) -> str:
    """Return sentences on the items that are missing; "" if everything is there.

    At most `most` of them are named.
    """
    some = [f"{p.there} of {p.text}" for p in pieces if 0 < p.share < 1]
    none = [p.text for p in pieces if not p.share]
    said = {"Incomplete": some, "Missing": none}
    return " ".join(f"{what}: {first_few(them, most)}." for what, them in said.items() if them)


def missing_flag(pieces: Sequence[Piece], rubric: Rubric) -> Flag:
    """Return the flag for missing items; its evidence names the criteria that they concern."""
    names = [piece.name for piece in pieces]
    own = [c for c in rubric.criteria if isinstance(c, RequiredPieces)]
    said = say_missing(pieces, most=6)
    return Flag(
        code="missing",
        parameters=tuple(names),
        message=said[0].lower() + said[1:],
        evidence={
            "missing": names,
            "criteria": [c.id for c in own if pieces_for(c, pieces, rubric)],
        },
    )


def data_flag(problems: Mapping[str, str]) -> Flag:
    """Return the flag for recordings with a problem."""
    first, problem = next(iter(problems.items()))
    others = len(problems) - 1
    have = "recording has" if others == 1 else "recordings have"
    more = f" {others} more {have} a problem." if others else ""
    return Flag(
        code="data_problem",
        parameters=tuple(problems),
        message=f"{first}: {sentence(problem)}{more}",
        evidence={"problems": dict(problems)},
    )


def _recordings(runs: RequiredRuns, experiments: Sequence[Experiment], *, carts: int) -> Piece:
    """Return required recordings as an item; a Bode table counts as all dwells."""
    of, many = f" of cart {', '.join(map(str, runs.carts))}" if runs.carts else "", runs.at_least
    word = _RECORDING.get(runs.kind, runs.kind)
    found = meeting(runs, experiments, carts=carts)
    return Piece(
        name=f"{many} {runs.kind}{of}" if many > 1 else f"{runs.kind}{of}",
        text=f"{many} {word}s{of}" if many > 1 else f"{word}{of}",
        kind=runs.kind,
        there=many if any(e.kind != runs.kind == "sine" for e in found) else len(found),
        needed=many,
    )


def meeting(
    runs: RequiredRuns, experiments: Sequence[Experiment], *, carts: int
) -> list[Experiment]:
    """Return the experiments that count for a requirement; Bode tables replace all dwells."""
    everyone = tuple(range(1, carts + 1))
    free = tuple(sorted(runs.carts)) or everyone
    kinds = _SERVES.get(runs.kind, (runs.kind,)) if free != everyone else (runs.kind,)
    tables = [e for e in experiments if e.kind == "bode"] if runs.kind == "sine" else []
    return tables or [e for e in experiments if e.kind in kinds and (e.carts or everyone) == free]


# ---------------------------------------------------------------------- sound recordings


def share_sound(context: GradingContext) -> Fraction:
    """Return the share of sound recordings among those that the rubric asks for.

    Bad recordings beyond the number asked for cost nothing, and missing ones are not judged here.
    If the rubric asks for no recordings, all count.
    """
    experiments, shares = context.submission.experiments, []
    for runs in context.rubric.required.experiments:
        handed = meeting(runs, experiments, carts=context.rubric.system.carts)
        needed = min(runs.at_least, len(handed))
        sound = sum(e.id not in context.bad for e in handed)
        shares += [Fraction(min(sound, needed), needed)] if needed else []
    if not shares and experiments:
        sound = sum(e.id not in context.bad for e in experiments)
        shares = [Fraction(sound, len(experiments))]
    return mean_share(shares) if shares else NONE


def lacking(context: GradingContext) -> dict[str, str]:
    """Return the initial numbers whose recordings are all unusable or missing, and what they need.

    These are gains, which rest on steps, and the frequency and damping of a cart alone, which rest
    on its decays. A fit to other recordings may know the numbers too, but it does not show that the
    students measured them. Recordings that the rubric does not require may be missing.
    """
    asked, carts = context.rubric.required.experiments, context.rubric.system.carts
    found = {}
    for name in context.rubric.names:
        read = read_name(name)
        if read.is_by_eye or readings(name, context.analysis):
            continue
        of = () if read.is_gain else (read.cart or 1,)
        kind = "step" if read.is_gain else "decay"
        runs = RequiredRuns(kind=kind, carts=of)
        handed = meeting(runs, context.submission.experiments, carts=carts)
        required = any(one.kind == kind and (not of or one.carts == of) for one in asked)
        if all(e.id in context.bad for e in handed) if handed else required:
            found[name] = _recordings(runs, (), carts=carts).text
    return found
