"""Accept reported signs from a bench whose positive input drives the carts to negative x."""

from collections.abc import Mapping, Sequence
from decimal import Decimal

from pipeline.identify.recording_checks import is_reversed
from pipeline.names import read_name
from pipeline.results import Record
from pipeline.submission import Reported, ReportedFeedback, ReportedStateSpace

_NOTE = (
    "a positive input drives these carts towards negative x, so reported values with the opposite "
    "sign are read with the input reversed"
)


def accept_reversed_signs(
    reported: Reported, records: Sequence[Record]
) -> tuple[Reported, tuple[str, ...]]:
    """Return the numbers as reported on a bench that is not reversed, and a note if any changed.

    On a reversed bench, gains, B and the controller have the opposite sign in the log. Students may
    report them with this sign or as positive numbers; both are right.
    """
    if not is_reversed(records):
        return reported, ()
    turned = reported.model_copy(
        update={
            "initial": _gains(reported.initial),
            "final": _gains(reported.final),
            "state_space": _space(reported.state_space),
            "feedback": _feedback(reported.feedback),
        }
    )
    return turned, () if turned == reported else (_NOTE,)


def _gains(table: Mapping[str, Decimal]) -> dict[str, Decimal]:
    gains = {name: -value for name, value in table.items() if read_name(name).is_gain}
    return {**table, **gains} if gains and min(gains.values()) > 0 else dict(table)


def _space(space: ReportedStateSpace | None) -> ReportedStateSpace | None:
    if space is None or not any(space.B) or max(space.B) > 0:
        return space
    return space.model_copy(update={"B": tuple(-b if b else b for b in space.B)})


def _feedback(feedback: ReportedFeedback | None) -> ReportedFeedback | None:
    if feedback is None or feedback.prefilter is None or feedback.prefilter >= 0:
        return feedback
    gains = tuple(-gain for gain in feedback.gains)
    return feedback.model_copy(update={"gains": gains, "prefilter": -feedback.prefilter})
