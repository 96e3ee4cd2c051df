"""A plan made or added to: what `cartlab plan` and the desk do."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.bench.planning.plan import Plan
from pipeline.bench.planning.plan_file import load_plan, plan_path, save_plan
from pipeline.bench.planning.propose import extend_plan, propose_plan
from pipeline.bench.protocol.messages import Description
from pipeline.errors import DataError
from pipeline.submission import Submission


@dataclass(frozen=True, kw_only=True)
class MadePlan:
    """A plan as it is written now.

    Attributes
    ----------
    said : in one sentence, what was written.
    trouble : why the data could not help to choose; "": they could, or there are none.
    """

    plan: Plan
    path: Path
    said: str
    trouble: str


def make_plan(
    submission: Submission, *, stock: bool = False, progress: Callable[[str], None]
) -> MadePlan:
    """Write plan.toml, or add to it what the data allow.

    Parameters
    ----------
    stock : the bench knows the stock commands only.
    """
    carts = submission.system.carts
    bench = Description(name="stock", encoders=2, carts=carts) if stock else None
    there = plan_path(submission).exists()
    old = load_plan(submission) if there else propose_plan(submission, bench=bench)
    progress("asking the data what else to record")
    try:
        new, trouble = extend_plan(old, submission, bench=bench), ""
    except DataError as error:  # a plan that data cannot help stands as it is
        new, trouble = old, str(error)
    path = save_plan(new, submission)
    added = len(new.recordings) - len(old.recordings)
    said = f"{path}: {added} recordings added" if there else f"wrote {path}: check its [limits]"
    return MadePlan(plan=new, path=path, said=said, trouble=trouble)
