"""Which laws of friction a servo and a cart need, found by comparing simple and rich models.

The search of `cartlab gap` runs once for each model, with only the laws of that model.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.emps import FILES, SPRINGS, emps_record
from benchmarks.free_runs import left_out, percent
from benchmarks.page import Table
from pipeline.gap.explain import explain_gap
from pipeline.gap.types import Gap
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.results import Record
from pipeline.setup import Setup, Units
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import ecp_record

TITLE = "Which friction laws a servo needs"
WORDS = """
**Which laws of friction are worth having?** Most robot simulators have only Coulomb and viscous
friction. M. Duclusaud, G. Passault, V. Padois, O. Ly, *Extended Friction Models for the Physics
Simulation of Servo Actuators*, [arXiv 2410.08650](https://arxiv.org/abs/2410.08650) ([their
code](https://github.com/Rhoban/bam)), compare six models, M1 to M6, on four servos. Here are
those of their models that need no outer load, on two real axes.
"""
TOOLS = ()
COULOMB = ("coulomb_friction",)
STRIBECK = (*COULOMB, "stiction")
LADDER = (
    ("M1: Coulomb", COULOMB),
    ("M2: M1 + Stribeck", STRIBECK),
    ("M3: M1 + load", (*COULOMB, "load_friction")),
    ("M4: Stribeck + load", (*STRIBECK, "load_friction")),
    ("M4 + drag (speed squared)", (*STRIBECK, "load_friction", "quadratic_drag")),
    ("M2 + presliding (Dahl)", (*STRIBECK, "presliding_friction")),
)
VISCOUS, WHOLE = "viscous alone", "cartlab, whole catalogue"
# A constant force is not friction, but every model of an axis without a spring needs it.
ALWAYS = ("force_offset",)
CART = "DOF1_en1_input1"


@dataclass(frozen=True, kw_only=True)
class Axis:
    """A real axis with its records and its springs."""

    words: str
    records: Sequence[Record]
    bench: Setup


def axes() -> Iterator[Axis]:
    """Yield the axes for which there are recordings on this machine."""
    if (REAL_DATA / "emps" / FILES["train"]).exists():
        yield Axis(
            words="EMPS, training record",
            records=[emps_record("train")],
            bench=Setup(springs=SPRINGS, units=Units(position="m", input="V")),
        )
    folder = REAL_DATA / "ecp210-ucsd"
    if folder.is_dir():
        files = [folder / f"{CART}_test{i}.csv" for i in range(1, 6)]
        yield Axis(
            words="a cart of an ECP 210, five steps",
            records=[ecp_record(file, column=3, kind="step") for file in files],
            bench=Setup(springs=(True, False), units=Units(position="count", input="V")),
        )


def climb(axis: Axis) -> Iterator[Gap]:
    """Yield the result of each model, then the result with the whole catalogue."""
    for _, laws in LADDER:
        allowed = [find_effect(key) for key in (*laws, *ALWAYS)]
        yield explain_gap(axis.records, axis.bench, catalogue=allowed)
    yield explain_gap(axis.records, axis.bench, catalogue=CATALOGUE)


def laws_of(gap: Gap) -> str:
    """Return the names of the effects found."""
    return ", ".join(found.effect.key.replace("_", " ") for found in gap.effects)


def tables(*, quick: bool) -> list[Table]:
    """Return the held-out error of each model, on each axis."""
    found = [] if quick else list(axes())
    head = ["laws on offer"]
    rows = [[name] for name in (VISCOUS, *(name for name, _ in LADDER), WHOLE)]
    for axis in found:
        head += [f"{axis.words}: held-out error", "laws it took"]
        gaps = list(climb(axis))
        cells = [(percent(gaps[0].baseline), ""), *((percent(g.final), laws_of(g)) for g in gaps)]
        for row, pair in zip(rows, cells, strict=True):
            row += pair
    if not found:
        head.append("held-out error")
        rows = [left_out("all", quick=quick, columns=len(head))]
    return [Table(title="Held-out error, step by step", head=head, rows=rows, note=_NOTE)]


_NOTE = """
Beyond Coulomb friction, no friction law of these models helps much here. On EMPS, a force that
repeats along the travel helps more than Stribeck and load; the numbers of the Stribeck law are as
uncertain as they are large. On the cart, presliding helps more. The search is greedy, so a larger
model can use a law that a smaller one did not.

The error is that of free runs over held-out records, or the held-out part of a record, as a share
of the motion. All models except the first may add a constant force. A law is used only if it
lowers the held-out error. M5 separates motor load from outer load, and M6 adds its square. Both
axes are horizontal and carry no outer load, so M5 and M6 would equal M4. "Load" is the drive's
command. Their paper measures servos with gearboxes under a pendulum, where load matters most.
"""
