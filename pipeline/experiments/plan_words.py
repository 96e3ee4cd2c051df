"""Describe a plan for people: what is recorded, what must be held, how long it takes."""

from collections.abc import Collection, Sequence
from itertools import groupby

from pipeline.experiments.plan import Plan, Recording
from pipeline.submission import Submission
from pipeline.words.numbers import count


def plan_table(plan: Plan, submission: Submission, *, new: Collection[str] = ()) -> str:
    """Return the recordings in order, with a line whenever carts must be held or freed.

    Parameters
    ----------
    new : ids that were not in the plan before; each is marked with +.
    """
    n, done = submission.system.carts, recorded_ids(plan, submission)
    wide = max((len(recording.id) for recording in plan.recordings), default=0)
    lines = []
    for carts, group in groupby(plan.recordings, key=lambda recording: recording.carts):
        lines.append(f"{hold_words(carts, n=n)}:")
        for recording in group:
            mark = "✓" if recording.id in done else "+" if recording.id in new else " "
            lines.append(f" {mark} {recording.id:{wide}}  {what_words(recording, submission)}")
    limits, system = plan.limits, submission.system
    left = [recording for recording in plan.recordings if recording.id not in done]
    who = "the others" if done else "they"
    return "\n".join(
        [
            *lines,
            f"{count(len(plan.recordings), 'recording')}, {len(done)} done"
            + (f", {len(new)} new (+); " if new else "; ")
            + (f"{who} take {time_words(session_time(left))}" if left else "nothing to do"),
            f"limits: {limits.input:g} {system.input.unit}, "
            f"{limits.travel:g} {system.position.unit} from the zero",
        ]
    )


def plan_data(
    plan: Plan, submission: Submission, *, new: Collection[str] = ()
) -> dict[str, object]:
    """Return the plan with derived values for JSON; `new` as for `plan_table`."""
    done, everyone = recorded_ids(plan, submission), range(1, submission.system.carts + 1)
    recordings = [
        {
            **recording.model_dump(mode="json"),
            "held": [cart for cart in everyone if cart not in recording.carts],
            "duration": recording.duration,
            "recorded": recording.id in done,
            "new": recording.id in new,
        }
        for recording in plan.recordings
    ]
    left = [recording for recording in plan.recordings if recording.id not in done]
    units = {"input": submission.system.input.unit, "position": submission.system.position.unit}
    return {
        **plan.model_dump(mode="json"),
        "units": units,
        "recordings": recordings,
        "seconds_left": session_time(left),
    }


def recorded_ids(plan: Plan, submission: Submission) -> frozenset[str]:
    """Return the ids of the recordings that the submission already has."""
    return frozenset(r.id for r in plan.recordings) & {e.id for e in submission.experiments}


def session_time(recordings: Collection[Recording]) -> float:
    """Return the duration of recordings in s, with rests but without handling the carts."""
    return sum(recording.settle + recording.duration for recording in recordings)


def hold_words(carts: Sequence[int], *, n: int) -> str:
    """Return in words which carts to hold and which to free."""
    held = [cart for cart in range(1, n + 1) if cart not in carts]
    if not held:
        return "all carts free" if n > 1 else "cart 1 free"
    return f"hold {_carts(held)}, {_carts(carts)} free"


def _carts(carts: Sequence[int]) -> str:
    return ("cart " if len(carts) == 1 else "carts ") + " and ".join(map(str, carts))


def what_words(recording: Recording, submission: Submission) -> str:
    """Return the content of one recording and its duration, in words."""
    if recording.amplitude == 0:
        what = f"{recording.kind}: pull cart {recording.release} out, let it go"
    else:
        closed = recording.kind == "closed_loop"
        system = submission.system
        unit = system.position.unit if closed else system.input.unit
        what = f"{recording.kind.replace('_', ' ')}: {recording.wave}, "
        what += f"{recording.amplitude:g} {unit}, {recording.frequency:g} Hz"
        if recording.frequency_end is not None:
            what += f" to {recording.frequency_end:g} Hz"
        if recording.controller is not None:
            what += f", {recording.controller.type.replace('_', ' ')}"
            what += f" of cart {recording.controller.cart}"
    return f"{what}; {recording.duration:.0f} s, after {recording.settle:g} s of rest"


def time_words(seconds: float) -> str:
    """Return a duration as minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
