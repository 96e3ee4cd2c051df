"""Update the numbers and pictures of `docs/real-labs.md`, if the recordings are available.

    python docs/real_labs.py [--keep FOLDER] [LAB …]

The recordings may not be passed on, so they are not part of the project. FOLDER gets the
submissions; a gap analysis that already exists there is used again.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.silverbox import INTERVAL, TRAIN
from pipeline.cli.reports import explain, run_report
from pipeline.gap.types import Gap, read_gap
from pipeline.output import write_file
from pipeline.report.figures.style import drawing, panels, to_svg
from pipeline.report.make_report import Files
from pipeline.results import Analysis, LogDecrement
from pipeline.words.numbers import with_error
from pipeline.words.text import with_symbols
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import write_two_cart_submission

PAGE = Path(__file__).with_name("real-labs.md")
IMAGES = Path(__file__).with_name("images")
LIMIT_CYCLE = "07-Feb-2025_09_26_10.txt"


@dataclass(frozen=True, kw_only=True)
class Lab:
    """A submission of real recordings.

    Attributes
    ----------
    write : function that writes the submission into a new folder.
    figures : figures of the report and the gap analysis, with the names of their copies.
    """

    write: Callable[[Path], object]
    figures: Mapping[str, str]


def write_lab(folder: Path, data: str, system: str, runs: Mapping[str, str]) -> None:
    """Write a submission; `runs` maps each data file to the lines of its experiments."""
    (folder / "data").mkdir(parents=True)
    text = f"version = 1\n[system]\n{system}\n"
    for file, lines in runs.items():
        shutil.copyfile(REAL_DATA / data / file, folder / "data" / file)
        for number, own in enumerate(lines.split("\n\n"), start=1):
            name = Path(file).stem + (f"-{number}" if "\n\n" in lines else "")
            text += f'[[experiments]]\nid = "{name}"\nfile = "data/{file}"\n{own}\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")


def write_one(folder: Path) -> None:
    """Write a submission with five equal steps of cart 1 alone."""
    runs = {f"DOF1_en1_input1_test{i}.csv": 'kind = "step"' for i in range(1, 6)}
    write_lab(folder, "ecp210-ucsd", "carts = 1\nsprings = [true, false]", runs)


def write_day(folder: Path) -> None:
    """Write a submission with the recordings of one day.

    Cart 2 is moved by hand several times in a recording.
    """
    files = ("14-Feb-2025_09_22_43.txt", "14-Feb-2025_09_44_21.txt")
    runs = {file: 'kind = "decay"\ncarts = [2]' for file in files}
    write_lab(folder, "ecp210-2025", "carts = 2\nsprings = [true, true, false]", runs)


def write_silverbox(folder: Path) -> None:
    """Write a submission with three parts of the Silverbox's training record."""
    samples = 10_000
    starts = np.linspace(TRAIN[0], TRAIN[1] - samples, 3).astype(int)
    system = 'carts = 1\nsprings = [true, false]\nposition = { unit = "V" }\n'
    system += 'columns = { input = "V1", x1 = "V2" }'
    lines = f'kind = "sweep"\nsample_rate = {1 / INTERVAL}\nhold = "band_limited"\nwindow = '
    parts = (f"{lines}[{a * INTERVAL:.4f}, {(a + samples - 1) * INTERVAL:.4f}]" for a in starts)
    write_lab(folder, "silverbox", system, {"SNLS80mV.mat": "\n\n".join(parts)})


def write_emps(folder: Path) -> None:
    """Write a submission with the training record of the positioning axis."""
    system = 'carts = 1\nsprings = [false, false]\nposition = { unit = "m" }\n'
    system += 'columns = { time = "t", input = "vir", reference = "qg", x1 = "qm" }'
    write_lab(folder, "emps", system, {"DATA_EMPS.mat": 'kind = "closed_loop"'})


def write_servo(folder: Path) -> None:
    """Write a submission with the servo's sweep and its closed loop."""
    loop = 'kind = "closed_loop"\ncontrolled_cart = 1'
    runs = {"raw_data_freq.txt": 'kind = "sweep"', "raw_data_cl_step1.m": loop}
    write_lab(folder, "ecp220-servo", "carts = 1\nsprings = [false, false]", runs)


def write_torsion(folder: Path) -> None:
    """Write a submission with the step of a disk, whose input is only in the column of targets."""
    step = 'kind = "step"\ninput = { per_count = 0.001220703125 }\n'
    step += 'columns = { time = "t_received", input = "target_value", x1 = "cart1pos" }'
    system = "carts = 1\nsprings = [true, false]"
    write_lab(folder, "teensy-torsional", system, {"Jan141428.mat": step})


LABS = {
    "one": Lab(
        write=write_one,
        figures={"gap/figures/before-after-1.svg": "one-gap.svg"},
    ),
    "two": Lab(
        write=lambda folder: write_two_cart_submission(folder, REAL_DATA, steps=(1, 2, 3, 4, 5)),
        figures={
            "gap/figures/by-record.svg": "two-runs.svg",
            "report/figures/hardware.svg": "two-loop.svg",
        },
    ),
    "day": Lab(write=write_day, figures={"gap/figures/before-after-1.svg": "day-gap.svg"}),
    "emps": Lab(
        write=write_emps,
        figures={
            "gap/figures/before-after-1.svg": "emps-gap.svg",
            "gap/figures/effect-3.svg": "emps-cogging.svg",
        },
    ),
    "silverbox": Lab(
        write=write_silverbox, figures={"gap/figures/before-after-1.svg": "silverbox.svg"}
    ),
    "torsion": Lab(write=write_torsion, figures={"gap/figures/before-after-1.svg": "torsion.svg"}),
    "servo": Lab(write=write_servo, figures={"gap/figures/effect-1.svg": "servo.svg"}),
}


def main() -> None:
    """Update all labs, or those named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("labs", nargs="*", metavar="LAB", help=", ".join(LABS))
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.labs or LABS:
            make(name, (options.keep or Path(scratch)) / name)
    draw_limit_cycle()


def make(name: str, folder: Path) -> None:
    """Write a lab's submission, analyse it, and put its numbers and figures into the docs."""
    lab = LABS[name]
    if not folder.exists():
        lab.write(folder)
    if not (folder / "gap" / "gap.json").exists():
        explain(folder, out=None, pdf=False, progress=print)
    gap = read_gap((folder / "gap" / "gap.json").read_text(encoding="utf-8"))
    analysis = run_report(folder, out=None, files=Files(pdf=False))
    for figure, own in lab.figures.items():
        shutil.copyfile(folder / figure, IMAGES / f"real-{own}")
    lines = rows(analysis, gap)
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    page = PAGE.read_text(encoding="utf-8")
    head, rest = page.split(begin)
    write_file(PAGE, head + begin + "\n" + "\n".join(lines) + "\n\n" + end + rest.split(end)[1])


def rows(analysis: Analysis, gap: Gap) -> Iterator[str]:
    """Yield the lines of a lab's list of numbers."""
    for row in analysis.rows:
        if row.final is not None:
            number = with_unit(row.final.value, row.final.std, row.unit)
            yield f"- {with_symbols(row.name)}: {number}"
    driven = any(record.u is not None and np.any(record.u) for record in analysis.records)
    if analysis.fit is None and driven:
        # The report needs a run in open loop; the search for effects does not.
        chain, units = gap.chain, gap.chain.units
        yield f"- mass: {with_unit(chain.m[0], gap.chain_std.get('m_1'), units.m)}"
        yield f"- damping: {with_unit(chain.c[0], gap.chain_std.get('c_1'), units.c)}"
    rubbed = [d for d in analysis.log_decrements if d.law.is_friction]
    for cart in sorted({d.cart for d in rubbed}):
        own = [d for d in rubbed if d.cart == cart]
        decays = f"{len(own)} decay{'s' * (len(own) > 1)}"
        ratios = f"{span(own, _apparent)} → {span(own, _viscous)}"
        yield f"- ζ of cart {cart} from {decays}, friction ignored → included: {ratios}"
    for found in gap.effects:
        place = next((f", {what} {number}" for what, number in found.where.items()), "")
        values = ", ".join(
            f"{what.replace('_', ' ')} {with_unit(v.value, v.std, v.unit)}"
            for what, v in found.parameters.items()
        )
        yield f"- {found.effect.key.replace('_', ' ')}{place}: {values}"
    errors = f"{gap.baseline:.1%} → {gap.final:.1%} of the motion ({gap.verdict})"
    yield f"- error on held-out recordings, linear model → with effects: {errors}"
    repeats = gap.repeatability
    spread = f"; difference between repeats: {repeats:.1%}" if repeats else ""
    yield f"- noise: {100 * gap.noise_floor:.2g}%{spread}"


def with_unit(value: float, std: float | None, unit: str) -> str:
    """Return a number with its standard error and unit."""
    return f"{with_error(value, std)} {unit.replace('^2', '²').replace('^3', '³')}".rstrip()


def span(decays: list[LogDecrement], of: Callable[[LogDecrement], float]) -> str:
    """Return the range of a value over some decays, as text."""
    values = [of(decay) for decay in decays]
    low, high = f"{min(values):.3f}", f"{max(values):.3f}"
    return low if low == high else f"{low} to {high}"


def _apparent(decay: LogDecrement) -> float:
    return decay.zeta


def _viscous(decay: LogDecrement) -> float:
    return decay.law.zeta


def draw_limit_cycle() -> None:
    """Draw a run in which the motor makes the swing grow, and which the analysis does not use."""
    columns = np.loadtxt(REAL_DATA / "ecp210-2025" / LIMIT_CYCLE, skiprows=1, delimiter="\t")
    part = columns[3500::12]
    with drawing():
        figure, (ax,) = panels(1.6)
        ax.plot(part[:, 1], part[:, 2], lw=0.9)
        ax.set_xlabel("time [s]")
        ax.set_ylabel("cart 1 [count]")
        svg = to_svg(figure, name="limit-cycle", alt="cart 1 swings more and more, then decays")
    write_file(IMAGES / "real-day-limit-cycle.svg", svg)


if __name__ == "__main__":
    main()
