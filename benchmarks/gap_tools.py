"""Compare the gap workflow with other tools that learn nonlinear models.

The other tools are in `benchmarks/black_boxes.py`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from matplotlib.figure import Figure

from benchmarks.black_boxes import ADAM, CELLS, FEATURES, LBFGS, LINEAR, STATES, error
from benchmarks.black_boxes import TOOLS as OTHERS
from benchmarks.free_runs import LINEAR_CART, OURS, Answer, others, ours, part_of, percent, words_of
from benchmarks.page import Table, installed, missing, share, spread
from pipeline.gap.explain import explain_gap
from pipeline.gap.types import Gap
from pipeline.results import Record
from pipeline.setup import Setup as SetUp
from pipeline.setup import Units
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import ecp_record
from tests.truth.cases import EFFECTS, further_records, make_case, make_rig

TITLE = "Hidden effects, and nonlinear models of them"
WORDS = """
**Which tool predicts a cart with a hidden effect, and can a person read its answer?** One cart on
a spring. All tools learn from the same records and choose their settings by the same held-out
records. Then they predict **further records that no tool has seen**: other steps, another sweep,
other releases. "Linear" is the best linear cart.
"""
TOOLS = ("pysindy", "sysidentpy", "scikit-learn", "jax-sysid")
RATE = 113.1  # Hz, the usual rate of the ECP 210
FIRST_SEED = 950_000
FURTHER = 1_000_000  # is added to a seed for the further records
REPEATS = 3  # runs of each kind on a class's bench, and as many again for judging
OF_ONE_CART = tuple(e for e in EFFECTS if e not in ("coupling_damper", "sensor_gain"))
# The library's term for an effect, or the one that a person would take for it.
TERM = {
    "coulomb_friction": "sign v",
    "stiction": "sign v",
    "presliding_friction": "sign v",
    "load_friction": "|u| sign v",
    "quadratic_drag": "v |v|",
    "cubic_spring": "x³",
    "force_offset": "1",
}
SHOWN = "coulomb_friction"  # equations are shown for this bench


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The hidden effects and each tool's answer; `gap` is cartlab's result."""

    hidden: tuple[str, ...]
    noise: float
    gap: Gap
    answers: dict[str, Answer]


def compare(
    records: Sequence[Record],
    further: Sequence[Record],
    *,
    springs: tuple[bool, ...],
    hidden: tuple[str, ...],
    unit: str,
) -> Bench:
    """Let every tool learn from cartlab's training runs, and test its model on further records."""
    began = time.process_time()
    gap = explain_gap(records, SetUp(springs=springs, units=Units(position=unit, input="V")))
    seconds = time.process_time() - began
    by_id = {record.id: record for record in records}
    training, choosing = (
        [part_of(by_id[name]) for name in names] for names in (gap.training, gap.held_out)
    )
    judged = [part_of(record) for record in further]
    answers = {}
    for name, model in ((LINEAR_CART, gap.linear), (OURS, gap.model)):
        made = ours(model, gap, springs=springs)
        answers[name] = Answer(model=made, error=error(made, judged), seconds=seconds)
    return Bench(
        hidden=hidden,
        noise=gap.noise_floor,
        gap=gap,
        answers=answers | dict(others(training, choosing, judged)),
    )


# ---------------------------------------------------------------------------- tables


def benches(*, quick: bool) -> list[Bench]:
    """Return benches of one cart with up to two effects, and one bench of a class."""
    plans: list[tuple[str, ...]] = [(), *((e,) for e in OF_ONE_CART)]
    plans.append(("coulomb_friction", "cubic_spring"))
    found = []
    for seed, plan in enumerate(plans[:1] if quick else plans, start=FIRST_SEED):
        case = make_case(seed=seed, n=1, effects=plan, rate=RATE)
        further = further_records(case, seed=seed + FURTHER)
        found.append(compare(case.records, further, springs=case.springs, hidden=plan, unit="cm"))
    if not quick:
        rig = make_rig(seed=FIRST_SEED, n=1, trials=2 * REPEATS)
        had = [record for record in rig.records if int(record.id[-1]) < REPEATS]
        further = [record for record in rig.records if int(record.id[-1]) >= REPEATS]
        hidden = ("coulomb_friction", "drive_damping")
        found.append(compare(had, further, springs=rig.springs, hidden=hidden, unit="cm"))
    return found


def is_found(gap: Gap, hidden: Sequence[str]) -> bool:
    """Return whether cartlab found exactly the hidden effects, whatever its verdict."""
    return sorted(f.effect.key for f in gap.effects) == sorted(hidden)


def is_named(bench: Bench) -> bool:
    """Return whether cartlab found exactly the hidden effects, with the right verdict."""
    verdict = "named" if bench.hidden else "none"
    return bench.gap.verdict == verdict and is_found(bench.gap, bench.hidden)


def sindy_says(bench: Bench) -> tuple[bool, int]:
    """Return whether PySINDy's equation has the hidden effect, and its number of other terms."""
    answer = bench.answers.get("PySINDy")
    found = set() if answer is None or answer.model is None else set(answer.model.terms)
    own = {TERM[key] for key in bench.hidden if key in TERM}
    return bool(own) and own <= found, len(found - own - set(LINEAR))


def each(found: Sequence[Bench]) -> Table:
    """Return a line for each bench."""
    names = [LINEAR_CART, OURS, *(name for name, _, _ in OTHERS)]
    rows = []
    for bench in found:
        cells = [
            percent(bench.answers[name].error) if name in bench.answers else "not installed"
            for name in names
        ]
        found_all = is_found(bench.gap, bench.hidden)
        said = f"**{bench.gap.verdict}**" if found_all else words_of(bench.gap)
        rows.append([_hidden(bench), percent(bench.noise), *cells, said])
    head = ["hidden", "noise", *names, "cartlab says"]
    return Table(
        title="Bench by bench: error on further records",
        head=head,
        rows=rows,
        note=_TOOLS_NOTE,
        picture=lambda: picture(found),
        in_file=True,
    )


def picture(found: Sequence[Bench]) -> Figure:
    """Draw each tool's error on every bench against the bench's noise."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    axes = figure.subplots()
    names = (OURS, *(name for name, _, _ in OTHERS), LINEAR_CART)
    for name, mark in zip(names, "oDs^v_", strict=True):
        answered = [
            (number, bench.answers[name].error / bench.noise)
            for number, bench in enumerate(found, start=1)
            if name in bench.answers
        ]
        if answered:
            axes.plot(*zip(*answered, strict=True), mark, markersize=5, label=name)
    axes.set(yscale="log", xlim=(0, len(found) + 1))
    axes.set_xlabel("bench, in the order of the table", labelpad=12)
    axes.set_ylabel("error over the noise", labelpad=20)
    axes.axhline(1.0, color="#888888", linewidth=0.8)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def _hidden(bench: Bench) -> str:
    return " + ".join(key.replace("_", " ") for key in bench.hidden) or "nothing"


def summary(found: Sequence[Bench]) -> Table:
    """Return a line for each tool."""
    with_term = [b for b in found if b.hidden and all(key in TERM for key in b.hidden)]
    named, stands = [is_named(b) for b in found], [sindy_says(b)[0] for b in with_term]
    alone = [says and beside == 0 for says, beside in map(sindy_says, with_term)]
    reads = {
        LINEAR_CART: "–",
        OURS: f"exactly the effects: {share(sum(named), len(named))}",
        "PySINDy": f"its term, if the library has it: {share(sum(stands), len(stands))}, "
        f"without others: {sum(alone)}",
        "SysIdentPy, FROLS": "no: products of past samples",
        "scikit-learn, MLP NARX": "no: weights",
        "jax-sysid, RNN": "no: weights",
    }
    rows = []
    for name, tool in ((LINEAR_CART, ""), (OURS, ""), *(other[:2] for other in OTHERS)):
        if tool and not installed(tool):
            rows.append(missing(name, columns=5))
            continue
        answers = [b.answers[name] for b in found]
        ratio = [a.error / b.noise for a, b in zip(answers, found, strict=True)]
        best_of = [
            min(b.answers, key=lambda n, b=b: b.answers[n].error if n != LINEAR_CART else inf)
            for b in found
        ]
        rows.append(
            [
                name,
                spread(ratio),
                "–" if name == LINEAR_CART else f"{best_of.count(name)} of {len(found)}",
                "–" if name == LINEAR_CART else spread([a.seconds for a in answers]),
                reads[name],
            ]
        )
    head = [
        "tool",
        "error over the noise",
        "best",
        "s of a core",
        "can a person read the effect?",
    ]
    return Table(
        title="All benches together",
        head=head,
        rows=rows,
        better=_SUMMARY_BETTER,
        note=_SUMMARY_NOTE,
    )


def equations(found: Sequence[Bench]) -> Table:
    """Return each tool's own equation for one bench."""
    rows = []
    for bench in found:
        if bench.hidden == (SHOWN,):
            for name, answer in bench.answers.items():
                if name != LINEAR_CART and answer.model is not None:
                    rows.append([name, answer.model.words.replace("|", "&#124;")])
    title = f"One example: answers about {SHOWN.replace('_', ' ')}"
    return Table(title=title, head=["tool", "answer"], rows=rows)


RIGS = (
    ("a cart of an ECP 210, driven: five steps", "DOF1_en1_input1", "step"),
    ("another, let go by hand: five decays", "DOF1_en2_manual2", "decay"),
)


def real_rigs(*, quick: bool) -> Table:
    """Return the errors on recordings of a real bench."""
    names = [LINEAR_CART, OURS, *(name for name, _, _ in OTHERS)]
    head = ["rig", "noise", *names, "cartlab says"]
    folder, rows = REAL_DATA / "ecp210-ucsd", []
    for words, file, kind in RIGS:
        if quick or not folder.is_dir():
            rows.append(
                [words, "left out: " + ("quick" if quick else "the recordings are not here")]
            )
            rows[-1] += [""] * (len(head) - 2)
            continue
        records = [
            ecp_record(folder / f"{file}_test{i}.csv", column=3, kind=kind) for i in range(1, 6)
        ]
        had, further = records[:-1], records[-1:]
        bench = compare(had, further, springs=(True, False), hidden=(), unit="count")
        cells = [
            percent(bench.answers[name].error) if name in bench.answers else "not installed"
            for name in names
        ]
        rows.append([words, percent(bench.noise), *cells, words_of(bench.gap)])
    return Table(title="Real carts", head=head, rows=rows, note=_RIGS_NOTE)


_TOOLS_NOTE = f"""
Errors are those of free runs: after the first readings, a model has only the input. They are root
mean square, as a share of the motion. Each tool tries several settings and keeps the smallest
model whose held-out error is within a tenth of the best.

- PySINDy: position and velocity as states; {len(FEATURES)} terms that an engineer would write (up
  to the third degree, sign v, v|v|, |u| sign v); smoothed differences over 5 to 15 samples; STLSQ
  with normalised columns at six thresholds. Without past inputs it cannot express a delay or a
  lag.
- SysIdentPy: a polynomial NARX up to the third degree, 2 to 6 lags of every second, fourth or
  eighth sample. FROLS chooses up to 15 terms by the Akaike criterion (its defaults).
- scikit-learn: a network with two layers of eight, 2 to 6 lags of every, every second or every
  fourth sample. Its documentation recommends L-BFGS for few data.
- jax-sysid: a recurrent network with {STATES} states and {CELLS} cells, and a linear part, on
  every fourth sample. As in its documentation, {ADAM} steps of Adam, then at most {LBFGS} of
  L-BFGS; two strengths of a group lasso on the states. The first 48 readings give the initial
  state.
"""
_SUMMARY_BETTER = """
**Others are better** outside this lab: they model systems that are not carts. PySINDy accepts any
term that you add to its library, and the networks need no idea of the effect. On the real decays
below, cartlab is worst, worse than the linear cart: it names a hidden mass, and the first readings
do not show how that mass moves. If the start is fitted to the whole record, its error is a fifth
of the linear cart's. In simulation cartlab has an advantage: its catalogue contains every hidden
effect. With several carts, some held, the other tools would need a model for each arrangement.
"""
_SUMMARY_NOTE = """
Error over the noise: median and quartiles over all benches. "Exactly the effects" counts the
verdict `named` with no effect missing or added, or `none` if nothing is hidden. Seconds include
all settings tried.
"""
_RIGS_NOTE = """
The last of five runs is the further record. Decays begin where the hand lets go. `partial`: an
effect outside cartlab's catalogue remains. All five steps have the same input, so a tool that
memorised the motion would look as good as one that knows the cart. Friction on this bench also
changes from run to run, which no model of other runs can predict.
"""


def tables(*, quick: bool) -> list[Table]:
    """Compare on simulated benches and on real carts."""
    warm = make_case(seed=FIRST_SEED, n=1, rate=RATE)
    explain_gap(
        warm.records, SetUp(springs=warm.springs), budget=0.0
    )  # compiles the simulator before the clock starts
    found = benches(quick=quick)
    return [
        summary(found),
        each(found),
        equations(found),
        real_rigs(quick=quick),
    ]
