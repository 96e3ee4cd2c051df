"""The gap workflow against what people learn nonlinear models with, on records that nobody had.

The others are in `benchmarks/black_boxes.py`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from matplotlib.figure import Figure

from benchmarks.black_boxes import FEATURES, LINEAR, error
from benchmarks.black_boxes import TOOLS as OTHERS
from benchmarks.free_runs import (
    LINEAR_CART,
    OURS,
    Answer,
    others,
    ours,
    part_of,
    percent,
    words_of,
)
from benchmarks.page import Table, installed, missing, share, spread
from pipeline.gap.explain import explain_gap
from pipeline.gap.types import Gap
from pipeline.results import Record
from pipeline.set_up import Bench as SetUp
from pipeline.set_up import Units
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import ecp_record
from tests.truth.cases import EFFECTS, further_records, make_case, make_rig

TITLE = "Hidden effects, and nonlinear models of them"
WORDS = """
One cart on a spring with something hidden in it. All tools learn from the same records (those that
cartlab trains on), choose by the same others (those it holds out), and are judged on **further
records that nobody had**: steps and a sweep of other sizes, other releases, other noise. All that
is chosen by, or judged, is a **free run**: from the first readings on, a model has the input alone.
Errors are of the motion, root mean square. "Linear" is cartlab's best linear cart. The others
choose, among their settings, the model with the fewest terms among those within a tenth of the
best. One cart is what suits them: of several carts, some held, a polynomial or a network has to be
learnt for each arrangement, while cartlab takes the records as they come.
"""
TOOLS = ("pysindy", "sysidentpy", "scikit-learn")
RATE = 113.1  # Hz, the ECP's usual
FIRST_SEED = 950_000
FURTHER = 1_000_000  # added to a seed: of the records that nobody had
REPEATS = 3  # of each run of a class's bench; as many again to judge by
OF_ONE_CART = tuple(e for e in EFFECTS if e not in ("coupling_damper", "sensor_gain"))
# The term of the library that is the effect, or that a person would take for it.
TERM = {
    "coulomb_friction": "sign v",
    "stiction": "sign v",
    "presliding_friction": "sign v",
    "load_friction": "|u| sign v",
    "quadratic_drag": "v |v|",
    "cubic_spring": "x³",
    "force_offset": "1",
}
SHOWN = ("coulomb_friction", "cubic_spring", "quadratic_drag")  # whose equations are shown


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What was hidden and what each tool made of it; `gap` is cartlab's account."""

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
    """Let every tool learn and choose as cartlab does, by its sides; judge by further records."""
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
    """Return twenty benches of one cart: nothing hidden, each effect, two of them, a class's."""
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
    """Tell whether cartlab's account has the hidden effects and no others, whatever its verdict."""
    return sorted(f.effect.key for f in gap.effects) == sorted(hidden)


def is_named(bench: Bench) -> bool:
    """Tell whether cartlab says what was hidden and nothing else, and that this is all."""
    verdict = "named" if bench.hidden else "none"
    return bench.gap.verdict == verdict and is_found(bench.gap, bench.hidden)


def sindy_says(bench: Bench) -> tuple[bool, int]:
    """Tell whether the hidden effect's own term stands in the equation, and how many beside it."""
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
        stands, beside = sindy_says(bench)
        found_all = is_found(bench.gap, bench.hidden)
        said = f"**{bench.gap.verdict}**" if found_all else words_of(bench.gap)
        term = ("its term, " if stands else "") + f"{beside} nonlinear beside"
        term = term if "PySINDy" in bench.answers else ""
        rows.append([_hidden(bench), percent(bench.noise), *cells, said, term])
    head = ["hidden", "noise", *names, "cartlab says", "PySINDy's equation has"]
    return Table(
        title="Bench by bench: free-run error on records that nobody had",
        head=head,
        rows=rows,
        note=_TOOLS_NOTE,
        picture=lambda: picture(found),
    )


def picture(found: Sequence[Bench]) -> Figure:
    """Draw every bench's error over its noise, a mark a tool."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    axes = figure.subplots()
    names = (OURS, *(name for name, _, _ in OTHERS), LINEAR_CART)
    for name, mark in zip(names, "oDs^_", strict=True):
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
    figure.legend(loc="outside lower center", ncols=5)
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
        OURS: f"the effects and no others: {share(sum(named), len(named))}",
        "PySINDy": f"where the library has it, its term stands: {share(sum(stands), len(stands))}, "
        f"alone: {sum(alone)}",
        "SysIdentPy, FROLS": "no: products of past samples",
        "scikit-learn, MLP NARX": "no: weights",
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
        "the least",
        "s of a core",
        "can a person read the effect?",
    ]
    return Table(title="All benches together", head=head, rows=rows, note=_SUMMARY_NOTE)


def equations(found: Sequence[Bench]) -> Table:
    """Return what the tools say, word for word."""
    rows = []
    for bench in found:
        if len(bench.hidden) == 1 and bench.hidden[0] in SHOWN:
            for name, answer in bench.answers.items():
                if name != LINEAR_CART and answer.model is not None:
                    rows.append([_hidden(bench), name, answer.model.words.replace("|", "&#124;")])
    return Table(title="What they say", head=["hidden", "tool", "answer"], rows=rows)


RIGS = (
    ("a cart of an ECP 210, driven: five steps", "DOF1_en1_input1", "step"),
    ("another, let go by hand: five decays", "DOF1_en2_manual2", "decay"),
)


def real_rigs(*, quick: bool) -> Table:
    """Return the same of recordings of a real bench."""
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
PySINDy: position and its derivative as states, {len(FEATURES)} library terms that an engineer would
write down (products up to the third degree, sign v, v|v|, |u| sign v), smoothed finite differences
of order 4 over 5 to 15 samples, STLSQ with normalised columns at six thresholds, the input as the
mean of the holds around a sample. SysIdentPy: polynomial NARX up to the third degree, 2 to 6 lags
of every second, fourth or eighth sample, FROLS with the Akaike criterion and up to 15 terms (its
defaults), least squares. scikit-learn: a network of two layers of eight, lags of 2 to 6 of every,
every second or every fourth sample, L-BFGS, which its documentation recommends for few data.
"""
_SUMMARY_NOTE = """
Seconds are of one core and of all settings tried; the noise is that of the records cartlab holds
out, as a share of their motion. "The effects and no others" counts only what is said as `named`,
or `none` where nothing is hidden. What the others are good for: PySINDy writes down an equation,
of any terms that somebody puts into its library; the network needs no idea of what is hidden; they
and FROLS model systems that are no carts. PySINDy's library here has no past inputs, so that a
delay or a lag is beyond it. What only cartlab has here is the knowledge that it is a cart, and with
which effects carts come; effects hidden here are all of its catalogue, which a real bench need not
keep to: see the real carts below.
"""
_RIGS_NOTE = """
As above, but of five runs the last is the one that nobody had; decays are cut where the hand lets
go, and each tool starts from the first readings after it. `partial` says that something is left
that is not in cartlab's catalogue. All five steps are one input, so that what has learnt this one
motion by heart is not told apart from what knows the cart. Friction on this bench differs from run
to run, which nothing learnt from other runs can know.
"""


def tables(*, quick: bool) -> list[Table]:
    """Compare on simulated benches, on real carts, on the Silverbox."""
    warm = make_case(seed=FIRST_SEED, n=1, rate=RATE)
    explain_gap(warm.records, SetUp(springs=warm.springs), budget=0.0)  # compiles the simulator
    found = benches(quick=quick)
    return [
        summary(found),
        each(found),
        equations(found),
        real_rigs(quick=quick),
    ]
