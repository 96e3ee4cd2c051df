"""Simulated time records of a chain: steps and hand-released decays."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ExperimentKind, Hold, Record

COUNT = 0.00227  # cm, an ECP 210 encoder count
RATE = 113.0  # Hz, the usual rate of the ECP 210


def record_of(
    t: Array,
    u: Array | None,
    y: Array,
    *,
    kind: ExperimentKind,
    count: float = COUNT,
    id: str = "run",
    free: tuple[int, ...] | None = None,
    carts: tuple[int, ...] | None = None,
    omega: float | None = None,
    reference: Array | None = None,
    hold: Hold = "zero_order",
) -> Record:
    """Return positions (carts, samples) read by an encoder of this step; with 0 they are exact."""
    carts = carts or tuple(range(1, len(y) + 1))
    return Record(
        id=id,
        kind=kind,
        t=t,
        u=u,
        y=np.round(y / count) * count if count else y,
        carts=carts,
        free=carts if free is None else free,
        omega=omega,
        reference=reference,
        resolution=np.full(len(carts), count),
        hold=hold,
    )


def step_record(
    chain: Chain,
    *,
    rng: np.random.Generator,
    swing: float = 1.0,
    duration: float = 6.0,
    rate: float = RATE,
    jitter: float = 0.0,
    noise: float = 0.0005,
    count: float = COUNT,
    free: tuple[int, ...] | None = None,
    x0: Array | None = None,
    id: str = "step",
) -> Record:
    """Return a step that moves cart 1 by `swing` cm, on at 0.1 s and off after half the record."""
    carts = free or tuple(range(1, chain.n + 1))
    t = np.arange(int(duration * rate)) / rate
    t = t + jitter / rate * rng.uniform(-0.5, 0.5, t.size)
    u = np.where((t > 0.1) & (t < duration / 2), swing / chain.static_gains()[0], 0.0)
    y = simulate_linear(chain, t, u, free=carts, x0=x0)
    y = y + noise * rng.standard_normal(y.shape)
    return record_of(t, u, y, kind="step", carts=carts, count=count, id=id)


def decay_record(
    chain: Chain, *, free: tuple[int, ...], rng: np.random.Generator, id: str = "decay"
) -> Record:
    """Return a record of carts that are pulled aside within 0.5 s, held for 1 s and released.

    The encoder's zero is not the rest position.
    """
    t = np.arange(int(7.0 * RATE)) / RATE
    x0 = np.zeros(2 * len(free))
    x0[0::2] = rng.uniform(1.0, 2.0, len(free))  # cm
    pull, hold = int(0.5 * RATE), int(1.0 * RATE)
    after = t[: t.size - pull - hold]
    y = np.concatenate(
        [
            x0[0::2, None] * np.linspace(0, 1, pull),
            np.repeat(x0[0::2, None], hold, axis=1),
            simulate_linear(chain, after, np.zeros(after.size), free=free, x0=x0),
        ],
        axis=1,
    )
    y = y + 0.3 + 0.0005 * rng.standard_normal(y.shape)
    return record_of(t, None, y, kind="decay", carts=free, id=id)


def random_chain(n: int, rng: np.random.Generator) -> tuple[Chain, tuple[bool, ...]]:
    """Return a random chain of n carts in cm and V, and which springs it has.

    Each cart alone swings at about 6 to 60 rad/s with a damping ratio from 0.01 to 0.3. About half
    of the chains lack a spring to one of the walls.
    """
    omega = np.exp(rng.uniform(np.log(6), np.log(40)))
    m = 2e-4 * np.exp(rng.uniform(-0.7, 0.7, n))
    k = m.mean() * omega**2 * np.exp(rng.uniform(-0.9, 0.9, n + 1))
    if n == 1:
        k = np.array([k.sum(), 0.0])
    elif rng.random() < 0.5:
        k[rng.choice([0, n])] = 0.0
    zeta = np.exp(rng.uniform(np.log(0.01), np.log(0.3), n))
    c = 2 * zeta * np.sqrt((k[:-1] + k[1:]) * m)
    return Chain(m=m, c=c, k=k), tuple(bool(stiffness > 0) for stiffness in k)


def write_records(folder: Path, records: Iterable[Record], *, carts: int) -> Path:
    """Write records as a submission in cm and V, with the sign of the input stated."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    toml = f"version = 1\n[system]\ncarts = {carts}\ninput = {{ sign = 1 }}\n"
    for record in records:
        u = np.zeros(record.t.size) if record.u is None else record.u
        columns = {"time": record.t, "input": u}
        if record.reference is not None:
            columns["reference"] = record.reference
        columns |= {f"x{cart}": record.position(cart) for cart in record.carts}
        file = f"data/{record.id}.csv"
        rows = np.transpose([*columns.values()])
        np.savetxt(folder / file, rows, "%.6f", ",", header=",".join(columns), comments="")
        toml += f'[[experiments]]\nid = "{record.id}"\nkind = "{record.kind}"\nfile = "{file}"\n'
    (folder / "submission.toml").write_text(toml, encoding="utf-8")
    return folder
