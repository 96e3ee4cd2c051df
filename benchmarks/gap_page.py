"""Write `benchmarks/gap.md`: success rates and times of the gap workflow, and real rigs.

    python benchmarks/gap_page.py RESULTS.jsonl… [--rig FOLDER]

RESULTS are files from `gap_confusion.py --report`, and FOLDER has recordings of an ECP 210. If
either is not given, its part of the page stays as it is.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy.stats import beta

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.free_runs import start_at
from pipeline.estimation.force_balance import find_interventions
from pipeline.gap.explain import explain_gap
from pipeline.gap.fit import fit_baseline
from pipeline.gap.judge import Hypothesis, Study, fit_free_run, judge
from pipeline.gap.runs import prepare, split_holdout
from pipeline.gap.summary import make_traces
from pipeline.gap.types import Gap, Trace
from pipeline.output import write_file
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.effect import AugmentedChain
from pipeline.report.figures.gap import before_after_figure
from pipeline.report.figures.style import drawing, to_svg
from pipeline.results import Record
from pipeline.setup import Setup, Units

PAGE = Path(__file__).with_name("gap.md")
FIGURES = Path(__file__).with_name("figures")
SUITES = {
    "clean": "nothing",
    "singles": "one effect, full size",
    "small": "one effect, 0.3 of it",
    "pairs": "two effects",
    "wide": "one effect, sizes over a decade",
    "wide-pairs": "two effects, sizes over a decade",
}
PLUCKED = (
    "07-Feb-2025_10_34_21.txt",
    "07-Feb-2025_11_28_21.txt",
    "14-Feb-2025_09_22_43.txt",
    "14-Feb-2025_09_44_21.txt",
)
RIGHT = ("exact", "equivalent", "ambiguous, right first")
_MUCH = 2.0  # noises left
_THINNED = 2  # samples per point of a figure


# ----------------------------------------------------------------------------- tables


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def summary_of(rows: Sequence[dict]) -> str:
    """Return, for each suite, the number of right answers, the remaining error, and the time."""
    out = []
    for suite, words in SUITES.items():
        cases = [row for row in rows if row["suite"] == suite]
        if not cases:
            continue
        right = sum(_is_right(row) for row in cases)
        left = np.array([row["final"] for row in cases])
        cpu = np.array([row["cpu"] for row in cases])
        out.append(
            [
                words,
                str(len(cases)),
                f"{right} ({_bounds(right, len(cases))})",
                f"{np.median(left):.2f}, {np.quantile(left, 0.9):.2f}",
                f"{np.mean(left <= _MUCH):.1%}",
                f"{np.median(cpu):.1f}, {np.quantile(cpu, 0.9):.1f}, {cpu.max():.1f}",
            ]
        )
    head = ["hidden", "cases", "right (95 % bounds)", "gap left, in noises: median, 90 %"]
    return table([*head, "at most 2 noises left", "s of one core: median, 90 %, most"], out)


def _is_right(row: dict) -> bool:
    return row["verdict"] == "none" if not row["truth"] else row["outcome"] in RIGHT


def _bounds(right: int, of: int) -> str:
    """Return a rate's 95 % bounds (C. J. Clopper, E. S. Pearson, Biometrika 26, 1934, 404-413)."""
    low = beta.ppf(0.025, right, of - right + 1) if right else 0.0
    high = beta.ppf(0.975, right + 1, of - right) if right < of else 1.0
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def confusion_of(rows: Sequence[dict]) -> str:
    """Return a table of the answers for each single effect."""
    out = []
    singles = [row for row in rows if row["suite"] in ("singles", "small", "wide")]
    for key in sorted({row["truth"][0][0] for row in singles}):
        cases = [row for row in singles if row["truth"][0][0] == key]
        other = Counter(_said(row) for row in cases if row["outcome"] != "exact")
        times = [_times([row for row in cases if row["n"] == n]) for n in (1, 2, 3)]
        exact = sum(row["outcome"] == "exact" for row in cases)
        words = "; ".join(f"{n} × {text}" for text, n in other.items())
        out.append([_named(key), str(len(cases)), str(exact), words, *times])
    head = ["hidden", "cases", "named exactly", "else", "s of one core, 1 cart: median (most)"]
    return table([*head, "2 carts", "3 carts"], out)


def _said(row: dict) -> str:
    found = " + ".join(_named(key) + (f" {place}" if place else "") for key, place in row["found"])
    left = f" ({row['final']:.1f} noises left)" if row["final"] > _MUCH else ""
    return f"{row['outcome']}: {found or 'nothing'}{left}"


def _named(key: str) -> str:
    return key.replace("_", " ")


def _times(rows: Sequence[dict]) -> str:
    cpu = [row["cpu"] for row in rows]
    return f"{np.median(cpu):.1f} ({max(cpu):.1f})" if cpu else ""


def pairs_of(rows: Sequence[dict]) -> str:
    """Return a table of the pairs of effects that were not named exactly."""
    pairs = [row for row in rows if row["suite"].endswith("pairs")]
    out = [
        [" + ".join(_named(key) for key, _ in row["truth"]), str(row["n"]), _said(row)]
        for row in pairs
        if row["outcome"] != "exact"
    ]
    times = [_times([row for row in pairs if row["n"] == n]) for n in (1, 2, 3)]
    text = f"One, two, three carts take {', '.join(times)} s of one core, median (most).\n"
    return text + ("\n" + table(["two effects", "carts", "said"], out) if out else "")


def sureness_of(rows: Sequence[dict]) -> str:
    """Return how often the true values lie within the stated errors."""
    z = np.array(
        [v for row in rows if row["outcome"] == "exact" for v in row["z"] if v is not None]
    )
    return (
        f"Of {z.size} parameters of effects named, {np.mean(np.abs(z) < 2):.0%} lie within two "
        f"of the standard errors stated and {np.mean(np.abs(z) < 3):.0%} within three.\n"
    )


# ------------------------------------------------------------------------- real rigs


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Recordings of a real rig, with the carts that are free in them."""

    name: str
    words: str
    records: tuple[Record, ...]
    springs: tuple[bool, ...]


def rigs_in(folder: Path) -> Iterator[Rig]:
    """Yield rigs with one free cart each, and the rig with both carts free."""
    from pipeline.submission import load_submission
    from pipeline.workflow import analyse
    from tests.helpers.ucsd import ecp_record, write_two_cart_submission

    singles = (
        ("cart-1", "cart 1 alone: five steps", "DOF1_en1_input1", "step"),
        ("cart-2", "cart 2 alone: five decays, let go by hand", "DOF1_en2_manual2", "decay"),
    )
    for name, words, file, kind in singles:
        records = tuple(
            ecp_record(folder / f"{file}_test{i}.csv", column=3, kind=kind) for i in range(1, 6)
        )
        yield Rig(name=name, words=words, records=records, springs=(True, False))
    with tempfile.TemporaryDirectory() as copy:
        lab = write_two_cart_submission(Path(copy) / "lab", folder.parent, steps=(1, 2, 3, 4, 5))
        analysis = analyse(load_submission(lab), design=False)
    parts = (
        ("held", "cart 1 in a bench of two, cart 2 held: five steps", "alone-1"),
        ("both", "both carts: five steps", "both"),
        ("all", "all fifteen runs at once: cart 1, cart 2 by hand, both", ""),
    )
    for name, words, start in parts:
        records = tuple(
            r for r in analysis.records if r.id.startswith(start) and r.kind != "closed_loop"
        )
        yield Rig(name=name, words=words, records=records, springs=analysis.bench.springs)
    with tempfile.TemporaryDirectory() as copy:
        lab = _write_plucked(Path(copy) / "lab", folder.parent / "ecp210-2025")
        analysis = analyse(load_submission(lab), design=False)
    yield Rig(
        name="plucked",
        words="another rig: cart 2 plucked by hand, up to three times in a recording",
        records=tuple(analysis.records),
        springs=analysis.bench.springs,
    )


def _write_plucked(lab: Path, folder: Path) -> Path:
    """Write a submission with the recordings in which cart 1 is held and a hand plucks cart 2."""
    lab.mkdir()
    text = ['version = 1\ntitle = "Plucked"\n[system]\ncarts = 2\nsprings = [true, true, false]\n']
    for number, name in enumerate(PLUCKED, start=1):
        shutil.copyfile(folder / name, lab / name)
        text.append(
            f'[[experiments]]\nid = "pluck-{number}"\nkind = "decay"\n'
            f'file = "{name}"\ncarts = [2]\n'
        )
    (lab / "submission.toml").write_text("".join(text), encoding="utf-8")
    return lab


def explain_rig(rig: Rig, tell: Callable[[str], None]) -> str:
    """Return the text on one rig, and draw a figure for each step."""
    cpu = time.process_time()
    gap = explain_gap(
        rig.records, Setup(springs=rig.springs, units=Units(position="count", input="V"))
    )
    cpu = time.process_time() - cpu
    tell(f"{rig.name}: {gap.verdict} {gap.baseline:.2%} -> {gap.final:.2%} in {cpu:.1f} s")
    repeats = f", repeats differ by {gap.repeatability:.2%}" if gap.repeatability else ""
    lines = [
        f"### {rig.words[0].upper()}{rig.words[1:]}\n",
        f"Verdict **{gap.verdict}**: {gap.baseline:.2%} of the motion on held-out runs with "
        f"the linear model, {gap.final:.2%} with the effects "
        f"(noise {gap.noise_floor:.2%}{repeats}); {cpu:.0f} s of one core.\n",
        *(f"{note[0].upper()}{note[1:]}.\n" for note in gap.notes),
        *_hands(gap),
    ]
    steps = _steps(gap, rig)
    for number, (found, (study, before, after)) in enumerate(
        zip(gap.effects, steps, strict=True), start=1
    ):
        place = next(iter(found.where.items()), None)
        where = f", {place[0]} {place[1]}" if place else ""
        values = ", ".join(
            f"{name.replace('_', ' ')} {value.value:.3g} {value.unit}".rstrip()
            for name, value in found.parameters.items()
        )
        trace = _where_it_helps(before, after, study)
        file = f"{rig.name}-{number}.svg"
        _draw(trace, study, file)
        lines += [
            f"{number}. **{_named(found.effect.key)}{where}** ({values}): "
            f"{found.nrmse_before:.2%} → {found.nrmse_after:.2%}\n",
            f"   ![Run {trace.experiment}, cart {trace.cart}: measured, linear model, model "
            f"with {number} effect{'s' * (number > 1)}, remaining errors](figures/{file})\n",
        ]
    return "\n".join(lines)


def _hands(gap: Gap) -> list[str]:
    """Return a sentence that lists when a hand moved a cart; the list is empty if none did."""
    if not gap.interventions:
        return []
    times = (f"{one.experiment} {one.start:.2f} to {one.end:.2f} s" for one in gap.interventions)
    return [f"Left out, because a hand moved the cart: {', '.join(times)}.\n"]


def _steps(gap: Gap, rig: Rig) -> Iterator[tuple[Study, Hypothesis, Hypothesis]]:
    """Yield the linear model paired with the fitted model of one effect, then two, and so on."""
    hands = find_interventions(rig.records)
    runs = prepare(rig.records, springs=rig.springs, interventions=hands, notes=[])
    training, held_out = split_holdout(runs, notes=[])
    linear, training = fit_baseline(training, springs=rig.springs, start=gap.linear.chain)
    study = Study(
        training=(),
        held_out=tuple(held_out),
        springs=rig.springs,
        catalogue=CATALOGUE,
        repeatability=gap.repeatability or 0.0,
        progress=print,
    ).with_noise(training)
    before = judge(linear, study)
    for count in range(1, len(gap.effects) + 1):
        model = AugmentedChain(chain=gap.model.chain, terms=gap.model.terms[:count])
        yield study, before, judge(fit_free_run(start_at(model, springs=rig.springs), study), study)


def _where_it_helps(before: Hypothesis, after: Hypothesis, study: Study) -> Trace:
    """Return the trace of the held-out run and cart in which the effects reduce the error most."""

    def gained(trace: Trace) -> float:
        left = [((trace.measured - model) ** 2).sum() for model in (trace.baseline, trace.final)]
        return float((left[0] - left[1]) / np.var(trace.measured))

    return max((t for t in make_traces(before, after, study) if t.held_out), key=gained)


def _draw(trace: Trace, study: Study, file: str) -> None:
    part = slice(None, None, _THINNED)
    thin = {key: getattr(trace, key)[part] for key in ("t", "u", "measured", "baseline", "final")}
    run = next(run for run in study.held_out if run.id == trace.experiment)
    noise = float(run.sigma[run.rows.index(trace.cart - 1)])
    with drawing():
        figure = before_after_figure(replace(trace, **thin), noise=noise, position_unit="count")
        svg = to_svg(figure, name=file, alt=f"{trace.experiment}, cart {trace.cart}")
    FIGURES.mkdir(exist_ok=True)
    write_file(FIGURES / file, svg)


# --------------------------------------------------------------------------- the page


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the page of the gap workflow's benchmarks.")
    parser.add_argument("results", nargs="*", type=Path)
    parser.add_argument("--rig", type=Path)
    options = parser.parse_args()
    parts: dict[str, str] = {}
    if options.results:
        lines = [json.loads(line) for path in options.results for line in path.open()]
        # if a case is in several files, the last file counts
        rows = list({(row["suite"], row["base"], row["index"]): row for row in lines}.values())
        parts["rates"] = summary_of(rows) + "\n" + sureness_of(rows)
        parts["confusion"] = confusion_of(rows)
        parts["pairs"] = pairs_of(rows)
    if options.rig:
        rigs = list(rigs_in(options.rig))
        explain_gap(
            rigs[0].records, Setup(springs=rigs[0].springs), budget=0.0
        )  # compiles the simulator before times are measured
        parts["rigs"] = "\n".join(explain_rig(rig, print) for rig in rigs)
    page = PAGE.read_text(encoding="utf-8")
    for name, text in parts.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
        head, rest = page.split(begin)
        page = head + begin + "\n" + text + "\n" + end + rest.split(end)[1]
    write_file(PAGE, page)


if __name__ == "__main__":
    main()
