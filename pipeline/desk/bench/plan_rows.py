"""The plan of a folder as its page shows it: what is done, next or new, and why."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pipeline.desk.benches import BenchSession
from pipeline.errors import PipelineError
from pipeline.experiments.plan import (
    Plan,
    load_plan,
    plan_path,
    session_time,
    time_words,
    what_words,
)
from pipeline.names import parameter_names, read_name
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME, file_problem


def plan_ids(folder: Path) -> frozenset[str] | None:
    """Return the ids of the recordings in a folder's plan; None if it has no readable plan."""
    try:
        submission = load_submission(folder)
        if plan_path(submission).exists():
            return frozenset(one.id for one in load_plan(submission).recordings)
    except PipelineError:
        pass
    return None


def read_plan(
    folder: Path, *, session: BenchSession | None, before: Collection[str] | None
) -> dict[str, Any]:
    """Return what the page shows of the plan: its rows, the time still needed, what is wrong.

    Parameters
    ----------
    session : the last session in the folder; it knows why a run ended early.
    before : ids of the recordings that the plan had before the latest addition; None if no
        recording is new.
    """
    found = {"sound": False, "rows": [], "left": "", "wrong": "", "units": None, "parameters": []}
    found |= {"carts": 0, "recorded": 0}
    if not (folder / NAME).exists():
        return found
    try:
        submission = load_submission(folder)
        system = submission.system
        names = parameter_names(system.carts, rigid=not system.bench.tied)
        found |= {
            "sound": True,
            "carts": system.carts,
            "recorded": len(submission.experiments),
            "units": {"input": system.input.unit, "position": system.position.unit},
            "parameters": [(name, f"the {read_name(name).words}") for name in names],
        }
        if not plan_path(submission).exists():
            return found
        plan = load_plan(submission)
    except PipelineError as error:
        return found | {"sound": False, "wrong": str(error)}
    why = _why_again(session)
    return found | _describe(plan, submission, why=why, before=before)


def _describe(
    plan: Plan,
    submission: Submission,
    *,
    why: Mapping[str, str],
    before: Collection[str] | None,
) -> dict[str, Any]:
    """Return a row for each recording, and the total time of the recordings still to make."""
    done = {experiment.id for experiment in submission.experiments}
    left = [recording for recording in plan.recordings if recording.id not in done]
    following = left[0].id if left else ""
    rows = [
        {
            "id": one.id,
            "what": what_words(one, submission),
            "done": one.id in done,
            "next": one.id == following,
            "new": before is not None and one.id not in before,
            "why": "" if one.id in done else why.get(one.id, _find_partial(submission, one.id)),
        }
        for one in plan.recordings
    ]
    return {"rows": rows, "left": time_words(session_time(left)) if left else ""}


def _why_again(session: BenchSession | None) -> dict[str, str]:
    """Return, by id, why a run of the last session must be repeated."""
    plan = session.snapshot().get("plan", ()) if session else ()
    return {entry["id"]: f"It ended early: {entry['why']}." for entry in plan if entry["why"]}


def _find_partial(submission: Submission, name: str) -> str:
    """Return a note if an earlier run of this recording ended early, else ""."""
    file = f"data/{name}.partial.txt"
    is_there = file_problem(submission.folder, file) is None
    return f"An earlier run ended early; what it recorded is in {file}." if is_there else ""
