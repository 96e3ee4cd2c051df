"""Make the mistake that each flag names, with an honest team's own data.

The mistakes use the recordings and the true bench, but never the grader's own catalogue.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.results import FrequencyResponse
from pipeline.setup import Setup
from pipeline.submission import Reported, ReportedFeedback
from tests.helpers.grading_class import Team, written

TURN = 2 * np.pi
OFF = (1.2, 1.6)  # factor of an error that no known mistake explains
SEEN_SWAPPED = 0.15  # difference in ln ω below which a swap of two carts cannot be seen


def change(team: Team, **tables: Mapping[str, float]) -> Team:
    """Return the team with other numbers in its tables, typed with the team's digits."""
    update = {
        label: {
            **getattr(team.reported, label),
            **{name: written(value, team.bench.digits) for name, value in numbers.items()},
        }
        for label, numbers in tables.items()
    }
    return reporting(team, team.reported.model_copy(update=update))


def reporting(team: Team, reported: Reported) -> Team:
    """Return the team with another report."""
    return replace(team, submission=team.submission.model_copy(update={"reported": reported}))


def scaled(team: Team, names: list[str], factor: float, tables: list[str]) -> Team:
    """Return the team with some numbers of some tables multiplied by a factor."""
    return change(team, **{t: {x: factor * team.value(t, x) for x in names} for t in tables})


def own(team: Team, symbol: str) -> list[str]:
    """Return the names of the carts' own parameters: K_1 …, or K for a single cart."""
    n = team.bench.chain.n
    if n == 1:
        return ["omega_n" if symbol == "omega" else symbol]
    return [f"{symbol}_{i}" for i in range(1, n + 1)]


def some_tables(team: Team) -> list[str]:
    """Return one of the tables, or both."""
    return [["initial"], ["final"], ["initial", "final"]][int(team.rng.integers(3))]


# ------------------------------------------------------------------------ the tables


def hz(team: Team) -> Team:
    """Divide all frequencies by 2π."""
    names = [n for n in team.reported.final if n.startswith("omega")]
    return scaled(team, names, 1 / TURN, some_tables(team))


def hz_of_one(team: Team) -> Team:
    """Divide one frequency by 2π, as if the team had left only this one in Hz."""
    names = [n for n in team.reported.final if n.startswith("omega")]
    return scaled(team, [str(team.rng.choice(names))], 1 / TURN, some_tables(team))


def peak_count(team: Team) -> Team:
    """Count one period too many or too few in every decay."""
    k = int(team.rng.integers(1, 7))
    ratio = (k + 1) / k if team.rng.random() < 0.7 else k / (k + 1)
    numbers = {name: team.value("initial", name) * ratio for name in own(team, "omega")}
    numbers |= {name: team.value("initial", name) / ratio for name in own(team, "zeta")}
    return change(team, initial=numbers)


def peak_for_steady_state(team: Team) -> Team:
    """Read every gain at the largest excursion after the first edge of the first step."""
    step = next(r for r in team.analysis.records if r.kind == "step" and len(r.carts) > 0)
    assert step.u is not None
    on = np.flatnonzero(step.u)
    inside = slice(int(on[0]), int(on[-1]))
    moved = (step.y[:, inside] - step.y[:, :1]) / step.u[on[0]]
    return change(team, initial=dict(zip(own(team, "K"), moved.max(axis=1).tolist(), strict=True)))


def peak_to_peak(team: Team) -> Team:
    """Double every gain."""
    return scaled(team, own(team, "K"), 2.0, some_tables(team))


def counts_for_length(team: Team) -> Team:
    """Give every gain in encoder counts."""
    return scaled(team, own(team, "K"), 1 / team.bench.count, some_tables(team))


def log10_for_ln(team: Team) -> Team:
    """Compute every decrement with the wrong logarithm."""
    return scaled(team, own(team, "zeta"), np.log10(np.e), ["initial"])


def carts_swapped(team: Team) -> Team:
    """Swap two carts' gains, their frequencies and dampings, or all these numbers."""
    i, j = team.rng.choice(np.arange(1, team.bench.chain.n + 1), 2, replace=False)
    groups = [["K"], ["omega", "zeta"], ["K", "omega", "zeta"]][int(team.rng.integers(3))]
    truth = team.bench.chain.parameters()

    def alike(symbol: str) -> bool:
        return abs(np.log(truth[f"{symbol}_{i}"] / truth[f"{symbol}_{j}"])) < SEEN_SWAPPED

    groups = [g for g in groups if g == "zeta" or not alike(g)]
    groups = [g for g in groups if g != "zeta" or "omega" in groups]
    if not groups:  # nobody could see this swap
        return team
    exchanged = {
        t: {f"{g}_{a}": team.value(t, f"{g}_{b}") for g in groups for a, b in ((i, j), (j, i))}
        for t in some_tables(team)
    }
    return change(team, **exchanged)


def no_fit_done(team: Team) -> Team:
    """Copy the initial table as the final one."""
    return reporting(team, team.reported.model_copy(update={"final": team.reported.initial}))


def _one_off(team: Team, table: str) -> Team:
    known = [n for n in team.reported.final if not n.startswith("zeta")]
    if table == "initial":
        known = [*own(team, "K"), *own(team, "omega")]
    while True:
        name = str(team.rng.choice(known))
        factor = team.rng.uniform(*OFF) ** float(team.rng.choice([-1, 1]))
        moved = scaled(team, [name], factor, [table])
        gains = [moved.value(table, other) for other in own(team, "K")]
        if gains == sorted(gains, reverse=True):  # in real carts the gains fall in this order
            return moved


def final_off(team: Team) -> Team:
    """Make one gain or frequency in the final table wrong, but not by any known mistake."""
    return _one_off(team, "final")


def initial_off(team: Team) -> Team:
    """Make one cart's gain or frequency in the initial table wrong, not by any known mistake."""
    return _one_off(team, "initial")


def initial_final_disagree(team: Team) -> Team:
    """Make the two tables disagree, without recordings that show which one is wrong."""
    runs = tuple(e for e in team.submission.experiments if e.kind == "closed_loop")
    moved = scaled(team, own(team, "K")[:1], 1.6, ["initial"])
    analysis = replace(
        team.analysis,
        records=tuple(r for r in team.analysis.records if r.kind == "closed_loop"),
        log_decrements=(),
        step_gains=(),
        sine_points=(),
        frequency_responses=(),
        fit=None,
        rows=tuple(replace(row, initial=None, final=None) for row in team.analysis.rows),
        checks=(),
    )
    submission = moved.submission.model_copy(update={"experiments": runs})
    return replace(team, submission=submission, analysis=analysis)


def physically_impossible(team: Team) -> Team:
    """Report a negative number, or a far cart that moves more than a near one."""
    if team.bench.chain.n == 1 or team.rng.random() < 0.5:
        names = [n for n in team.reported.final if not n.startswith("omega")]
        return scaled(team, [str(team.rng.choice(names))], -1.0, ["final"])
    return change(team, final={"K_2": 1.25 * team.value("final", "K_1")})


def transient_used(team: Team) -> Team:
    """Read amplitudes from the first cycles of every dwell, and fit them if that is possible."""
    if any(e.note for e in team.submission.experiments if e.kind == "sine"):
        return team  # the dwells begin after the transient
    truth = team.bench.chain.parameters()
    for cycles in team.rng.permutation([2.0, 3.0]):
        try:
            fit = fit_bode(
                _early(team, float(cycles)),
                bench=Setup(springs=team.bench.springs),
                initial=truth,
            )
        except DataError:  # no fit succeeds with such amplitudes; a student would try others
            continue
        if min(e.value for e in fit.parameters.values()) > 0:
            return change(team, final={name: e.value for name, e in fit.parameters.items()})
    return team


def _early(team: Team, cycles: float) -> list[FrequencyResponse]:
    """Return half the swing of the first cycles."""
    runs = [r for r in team.analysis.records if r.kind == "sine" and r.omega and r.u is not None]
    rows: list[Array] = []
    for run in runs:
        first = run.t - run.t[0] <= cycles * TURN / (run.omega or np.inf)
        assert run.u is not None
        rows.append(np.ptp(run.y[:, first], axis=1) / np.ptp(run.u))
    omega, magnitude = np.array([run.omega for run in runs]), np.array(rows).T
    return [
        FrequencyResponse(
            cart=cart,
            omega=omega,
            magnitude=magnitude[cart - 1],
            magnitude_std=0.01 * magnitude[cart - 1],
            phase=None,
            phase_std=None,
            source="table",
        )
        for cart in range(1, team.bench.chain.n + 1)
    ]


# ------------------------------------------------------------- the model, the loop, the rest


def wrong_state_space(team: Team) -> Team:
    """Report a state model with a wrong sign or coupling, another order of states, or ω for ω²."""
    space, n = team.reported.state_space, team.bench.chain.n
    assert space is not None
    A = [list(row) for row in space.A]
    kind = int(team.rng.integers(4))
    if kind == 0:
        A[1][0] = -A[1][0]
    elif kind == 1 and n > 1:
        A[1][2], A[3][0] = A[3][0], A[1][2]
        if abs(np.log(float(A[1][2] / A[3][0]))) < np.log(1.4):
            A[1][2] = A[3][0] = 0 * A[1][2]
    elif kind == 2 and n > 1:
        order = [*range(0, 2 * n, 2), *range(1, 2 * n, 2)]
        A = [[A[i][j] for j in order] for i in order]
    else:
        for i in range(n):
            A[2 * i + 1][2 * i] = written(
                -np.sqrt(abs(float(A[2 * i + 1][2 * i]))), team.bench.digits
            )
    space = space.model_copy(update={"A": tuple(map(tuple, A))})
    return reporting(team, team.reported.model_copy(update={"state_space": space}))


def _feedback(team: Team) -> ReportedFeedback:
    assert team.reported.feedback is not None
    return team.reported.feedback


def _controlling(team: Team, **update: object) -> Team:
    feedback = _feedback(team).model_copy(update=update)
    return reporting(team, team.reported.model_copy(update={"feedback": feedback}))


def wrong_gains(team: Team) -> Team:
    """Reverse the gains' signs, change their order, or report gains that were never tried."""
    gains = [float(g) for g in _feedback(team).gains]
    kind = int(team.rng.integers(3))
    if kind == 0:
        gains = [-g for g in gains]
    elif kind == 1 and team.bench.chain.n > 1:
        gains = [*gains[0::2], *gains[1::2]]
    else:
        gains = [2.5 * g for g in gains]
    team = _controlling(team, gains=tuple(written(g, 4) for g in gains))
    if team.rng.random() < 0.5:  # leave out the gains that ran
        return _with_runs(team, {"controller": None})
    return team


def _with_runs(team: Team, update: Mapping[str, object]) -> Team:
    runs = tuple(e.model_copy(update=update) for e in team.submission.experiments)
    return replace(team, submission=team.submission.model_copy(update={"experiments": runs}))


def wrong_prefilter(team: Team) -> Team:
    """Report the static gain as prefilter, no prefilter, or another number."""
    right = float(_feedback(team).prefilter or 1)
    wrong = [1 / right, 1.0, right * 1.3, right * 0.7]
    wrong = [w for w in wrong if abs(np.log(w / right)) > np.log(1.25)]
    return _controlling(team, prefilter=written(float(team.rng.choice(wrong)), 4))


def missing(team: Team) -> Team:
    """Leave out a parameter, the state model or the closed loop of the report."""
    kind = int(team.rng.integers(3))
    if kind == 0:
        final = dict(team.reported.final)
        del final[str(team.rng.choice(list(final)))]
        return reporting(team, team.reported.model_copy(update={"final": final}))
    if kind == 1:
        return reporting(team, team.reported.model_copy(update={"state_space": None}))
    runs = tuple(e for e in team.submission.experiments if e.kind != "closed_loop")
    return replace(team, submission=team.submission.model_copy(update={"experiments": runs}))


SLIPS: dict[str, Callable[[Team], Team]] = {
    "hz_for_rad_s": hz,
    "peak_count": peak_count,
    "peak_for_steady_state": peak_for_steady_state,
    "peak_to_peak": peak_to_peak,
    "transient_used": transient_used,
    "carts_swapped": carts_swapped,
    "counts_for_length": counts_for_length,
    "log10_for_ln": log10_for_ln,
    "no_fit_done": no_fit_done,
    "final_off": final_off,
    "initial_off": initial_off,
    "initial_final_disagree": initial_final_disagree,
    "physically_impossible": physically_impossible,
    "wrong_state_space": wrong_state_space,
    "wrong_gains": wrong_gains,
    "wrong_prefilter": wrong_prefilter,
    "missing": missing,
}
ONE_NUMBER = {"hz_for_rad_s": hz_of_one}
DOUBLE = (
    ("hz_for_rad_s", "carts_swapped"),
    ("counts_for_length", "carts_swapped"),
    ("peak_count", "log10_for_ln"),
    ("hz_for_rad_s", "log10_for_ln"),
    ("counts_for_length", "peak_to_peak"),
    ("wrong_state_space", "wrong_prefilter"),
    ("hz_for_rad_s", "peak_to_peak"),
)
OF_SEVERAL_CARTS = {"carts_swapped", "no_fit_done"}  # the numbers of one cart cannot show these
