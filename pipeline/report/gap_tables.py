"""The gap analysis as pandas tables, with columns named as in `gap.json`."""

from typing import TYPE_CHECKING

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.types import FoundEffect, Gap
from pipeline.json_files import keys, plain
from pipeline.results import Analysis

if TYPE_CHECKING:
    # Imported late, because this takes a fifth of a second.
    import pandas as pd

_PARAMETER = ("effect", "cart", "spring", "parameter", "value", "std", "unit")
_LEFT = ("experiment", "time", "cart", "position", "velocity", "input", "force")


def effects(gap: Gap) -> "pd.DataFrame":
    """Return the effects in the order found, one row each."""
    import pandas as pd

    return pd.DataFrame(plain(gap.effects, digits=17), columns=keys(FoundEffect))


def parameters(gap: Gap) -> "pd.DataFrame":
    """Return the effects' parameters, one row each; `cart` or `spring` is where the effect acts."""
    import pandas as pd

    rows = [
        {"effect": found.effect.key, **found.where, "parameter": name, "value": value.value,
         "std": value.std, "unit": value.unit}
        for found in gap.effects
        for name, value in (found.parameters | found.details).items()
    ]  # fmt: skip
    frame = pd.DataFrame(rows, columns=list(_PARAMETER))
    return frame.astype({"cart": "Int64", "spring": "Int64", "std": float})


def simulated(gap: Gap, experiment: str) -> "pd.DataFrame":
    """Return each cart's position by `time`, as measured and as simulated by two models."""
    import pandas as pd

    columns: dict[tuple[str, str], pd.Series] = {}
    for what, name in (("measured", "measured"), ("baseline", "linear"), ("final", "with_effects")):
        by_cart: dict[int, list[tuple[Array, Array]]] = {}
        for trace in gap.traces:
            if trace.experiment == experiment:
                by_cart.setdefault(trace.cart, []).append((trace.t, getattr(trace, what)))
        for cart, pieces in sorted(by_cart.items()):
            t, y = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
            columns[name, f"x{cart}"] = pd.Series(y, index=pd.Index(t, name="time")).sort_index()
    return pd.DataFrame(columns)


def residual(gap: Gap, *, analysis: Analysis) -> "pd.DataFrame":
    """Return the force that the model does not explain, one row per cart and short window."""
    import pandas as pd

    parts = [
        pd.DataFrame(
            {
                "experiment": one.experiment,
                "time": one.mean(one.t),
                "cart": one.cart,
                "position": one.mean(one.x),
                "velocity": one.mean(one.v),
                "input": one.mean(one.u),
                "force": one.force,
            }
        )
        for one in gap.left_forces
    ]
    frame = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(_LEFT))
    position, drive = analysis.bench.units.position, analysis.bench.units.input
    driven = any(np.any(one.u) for one in gap.left_forces)
    force = drive if driven else f"{position}/s^2"  # without an input, forces are divided by m_1
    frame.attrs["units"] = {
        "time": "s", "position": position, "velocity": f"{position}/s", "input": drive,
        "force": force,
    }  # fmt: skip
    return frame
