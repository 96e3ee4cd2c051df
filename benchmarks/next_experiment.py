"""How much chosen experiments help: predicted error, true error and bench time.

    python benchmarks/next_experiment.py [--seeds 4] [--dwells 24] [--next 1]

Each bench is a preset with the carts, encoders and controller of the emulator, simulated tick by
tick without a serial line. It records two steps and a sweep, then the experiment that `cartlab plan
--next` chooses. For comparison, it records as many log-spaced dwells as the paper, and the carts
are fitted to these dwells alone. The table and the figure of `benchmarks/next.md` are written.
"""

import argparse
import os
import re
import sys
import tempfile
from dataclasses import dataclass
from math import ceil
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.experiments.information import FisherInformation, largest_amplitude
from pipeline.experiments.next_recordings import choose_next
from pipeline.experiments.plan import Plan, Recording
from pipeline.experiments.propose import FURTHEST, propose_plan, renamed, rounded, rounded_down
from pipeline.output import write_file
from pipeline.plant.chain import PRESETS, Array, Chain
from pipeline.plant.simulate import SETTLED, SETTLED_DWELL, settling_wait, steady_time
from pipeline.report.figures.style import drawing, legend_above, small_multiples, to_svg
from pipeline.results import Analysis
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.virtual import VirtualBench, new_folder

PAGE = Path(__file__).with_name("next.md")
FIGURE = Path(__file__).with_name("figures") / "next.svg"


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """Stated and true relative errors of all named parameters after `seconds` of bench time."""

    seconds: float
    stated: Array
    off: Array


def known_after(bench: VirtualBench, analysis: Analysis, chain: Chain) -> Stage:
    """Return the stated and the true errors of the identified carts."""
    assert analysis.fit is not None
    found = analysis.fit.parameters.values()
    true = np.array(list(chain.parameters().values()))
    value, std = np.array([(e.value, e.std or np.nan) for e in found]).T
    return Stage(seconds=bench.seconds, stated=std / true, off=(value - true) / true)


def log_spaced(known: FisherInformation, plan: Plan, *, n: int) -> list[Recording]:
    """Return log-spaced dwells like the paper's, as large as the limits allow."""
    resonances = np.sort(np.abs(known.chain.poles)) / (2 * np.pi)
    wait = settling_wait(known.chain, time_constants=SETTLED_DWELL)
    dwells = []
    for i, f in enumerate(np.geomspace(0.7 * resonances[0], 1.5 * resonances[-1], n), start=1):
        hertz = round(float(f), 2)
        dwell = Recording(
            id=f"sine-{i:02d}",
            kind="sine",
            carts=tuple(range(1, known.chain.n + 1)),
            wave="sine",
            amplitude=1.0,
            frequency=hertz,
            cycles=ceil(hertz * (wait + steady_time(hertz))),
            settle=rounded(settling_wait(known.chain, time_constants=SETTLED)),
        )
        size = largest_amplitude(
            known.chain, dwell, limits=plan.limits, share=FURTHEST, period=known.sample_time
        )
        dwells.append(dwell.model_copy(update={"amplitude": rounded_down(size)}))
    return dwells


def run(preset: str, *, seed: int, n: int, dwells: int, scratch: Path) -> tuple[list[Stage], Array]:
    """Return the stages (first set, chosen, paper's dwells) and the predicted errors."""
    chain = PRESETS[preset]
    bench = VirtualBench(prepare_bench(preset=preset, model=None, hide=[]), seed=seed)
    springs = [True] * (chain.n + 1)
    folder = new_folder(scratch / f"{preset}-{seed}", bench, springs=springs)
    plan = propose_plan(load_submission(folder), bench=bench.description)
    first = [r for r in plan.recordings if r.kind != "decay"]
    bench.record(folder, first, limits=plan.limits)
    before = analyse(load_submission(folder))
    stages = [known_after(bench, before, chain)]
    known = FisherInformation.of(before)
    chosen = choose_next(before, plan, n=n, goal="worst", commands=bench.description.commands)
    told = known.information + sum(known.of_recording(one) for one in chosen.recordings)
    half = known.by_parameters() @ np.linalg.inv(told[0])
    promised = np.sqrt(np.diag(half @ told[1] @ half.T))
    bench.record(folder, renamed(chosen.recordings, taken=["sweep"]), limits=plan.limits)
    stages.append(known_after(bench, analyse(load_submission(folder)), chain))
    if dwells:
        other = VirtualBench(prepare_bench(preset=preset, model=None, hide=[]), seed=seed)
        folder = new_folder(scratch / f"{preset}-{seed}-dwells", other, springs=springs)
        other.record(folder, log_spaced(known, plan, n=dwells), limits=plan.limits)
        stages.append(known_after(other, analyse(load_submission(folder)), chain))
    return stages, promised


def row(preset: str, runs: list[tuple[list[Stage], Array]]) -> list[str]:
    """Return a row of the table; errors are root mean squares over parameters and seeds."""
    stages = [stage for stage, _ in runs]
    first, chosen = ([run[i] for run in stages] for i in (0, 1))
    dwells = [run[2] for run in stages if len(run) > 2]
    met = np.array([after.off / promised for (_, after, *_), promised in runs])
    cells = [preset]
    for group in (first, chosen, dwells):
        worst = 100 * np.sqrt(np.mean([np.square(s.off) for s in group], axis=0)).max()
        cells.append(f"{group[0].seconds:.0f} s, ± {worst:.2g} %")
    cells.append(f"{chosen[0].seconds / dwells[0].seconds:.2f}")
    stated = np.sqrt(np.nanmean([np.square(s.stated / p) for (_, s, *_), p in runs]))
    cells += [f"{np.sqrt(np.mean(met**2)):.2f}", f"{stated:.2f}", str(met.size)]
    return cells


def draw(results: dict[str, list[tuple[list[Stage], Array]]]) -> str:
    """Draw the largest error against bench time."""
    with drawing():
        figure, panels = small_multiples(list(results), height=1.9, share_y=True)
        for axes, runs in zip(panels, results.values(), strict=True):
            for number, (stages, _) in enumerate(runs):
                worst = [100 * np.nanmax(stage.stated) for stage in stages]
                seconds = [stage.seconds for stage in stages]
                label = ("first set, then chosen", "log-spaced dwells") if not number else ("", "")
                axes.plot(seconds[:2], worst[:2], "o-", color="C0", label=label[0])
                axes.plot(seconds[2:], worst[2:], "s", color="C1", label=label[1])
            axes.set(xlabel="time at the bench in s", yscale="log")
        panels[0].set_xlim(0.0)
        panels[0].set_ylabel("worst standard error in %")
        legend_above(panels[0])
        return to_svg(figure, name="next", alt="worst standard error against bench time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--dwells", type=int, default=24)
    parser.add_argument("--next", type=int, default=1)
    asked = parser.parse_args()
    results: dict[str, list[tuple[list[Stage], Array]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for preset in PRESETS:
            for seed in range(asked.seeds):
                dwells = 0 if seed else asked.dwells  # takes long, and gives the same each time
                one = run(preset, seed=seed, n=asked.next, dwells=dwells, scratch=Path(scratch))
                results.setdefault(preset, []).append(one)
                print(preset, seed, [round(stage.seconds) for stage in one[0]], flush=True)
    head = ["bench", "first set", "and chosen", "log-spaced dwells", "time, chosen over dwells"]
    head += ["error over promised", "stated error over promised", "parameters compared"]
    rows = [head, ["---"] * len(head), *(row(preset, runs) for preset, runs in results.items())]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in rows)
    print(table)
    write_file(FIGURE, draw(results))
    table += "\n\n![Worst standard error against time at the bench](figures/next.svg)"
    page = PAGE.read_text(encoding="utf-8")
    page = re.sub(
        r"(<!-- chosen -->\n).*?(<!-- end of chosen -->)", rf"\1\n{table}\n\n\2", page, flags=re.S
    )
    write_file(PAGE, page)


if __name__ == "__main__":
    main()
