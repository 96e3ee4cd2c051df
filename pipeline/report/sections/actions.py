"""What to do next: for every failed check, the most serious first, and further advice."""

from collections.abc import Iterator, Sequence

from pipeline.report.document import Items, bullet_list
from pipeline.report.sections.loops import CLOSE
from pipeline.report.sections.parameters import reported_off
from pipeline.results import Analysis, Check, Stage
from pipeline.words.numbers import listing
from pipeline.words.phrases import phrases
from pipeline.words.text import Span, Spans, clean, names_spans, rich, spans

_WORDS = phrases("summary")
_MOST_TOLD = 3  # most messages shown for one group of checks
# Groups of checks, the most serious first. Other groups come between these and `_LAST`.
_WORST_FIRST = (
    "input_sign",
    "springs",
    "data",
    "record",
    "position_unit",
    "input_unit",
    "position_scale",
    "input_scale",
    "groups",
    "setup",
    "held",
    "dwells",
    "late_channel",
    "fit_identified",
    "fit_converged",
    "physical",
    "vanishing",
    "covered",
    "repeats",
    "initial_final",
    "hardware",
    "feedback",
)
_LAST = ("fit_explains_data", "step", "decay")
_AT_THE_TOP = ("input_sign", "position_unit", "input_unit")  # problems that make every number wrong
# The summary already shows the messages of these groups.
_TOLD_ELSEWHERE = (*_AT_THE_TOP, "fit_identified")
# one message of such a group represents all its messages
_ALIKE = ("initial_final", "step", "decay")


def next_steps(analysis: Analysis) -> Items:
    """Return what to do about every failed check, the most serious first, and further advice."""
    failed, advice = list(_failed(analysis)), list(_advice(analysis))
    return bullet_list([*failed, *advice] or [_nothing_left(analysis)])


def _failed(analysis: Analysis) -> Iterator[Spans]:
    groups: dict[str, list[Check]] = {}
    for check in analysis.failed_checks:
        groups.setdefault(_group(check), []).append(check)
    for group in sorted(groups, key=_place):
        checks = sorted(groups[group], key=lambda check: check.excess, reverse=True)
        shown = checks[: 1 if group in _ALIKE else _MOST_TOLD]
        shown = () if group in _TOLD_ELSEWHERE else shown
        messages = dict.fromkeys(_sentence(clean(check.message)) for check in shown)
        yield _WORDS.spans(
            "failed",
            action=_action(group, checks, analysis),
            told=rich("".join(f"{message} " for message in messages)),
            names=_names(groups[group]),
        )
        if group == "input_sign":
            yield _WORDS.spans("next_again")


def _group(check: Check) -> str:
    """Return the group of checks to which a failed check belongs; each group has its own action.

    The group is the kind of the check. For checks of the fit and of the input it includes the part,
    because the parts ask for different actions.
    """
    return f"{check.kind}_{check.part}" if check.kind in ("fit", "input") else check.kind


def _place(group: str) -> tuple[int, int]:
    for part, groups in ((0, _WORST_FIRST), (2, _LAST)):
        if group in groups:
            return part, groups.index(group)
    return 1, 0


def _action(group: str, checks: Sequence[Check], analysis: Analysis) -> Spans:
    """Return what to do about the failed checks of a group."""
    if group == "initial_final":
        return _WORDS.spans("do_initial_final", names=names_spans([c.parameter for c in checks]))
    if group == "fit_identified":
        return _to_identify(analysis)
    if group == "decay":
        decays = {d.experiment for d in analysis.log_decrements} - analysis.steps
        return _WORDS.spans("do_decay" if decays else "do_first_decay")
    known = group in (*_WORST_FIRST, *_LAST)
    return _WORDS.spans(f"do_{group if known else 'other'}")


def _to_identify(analysis: Analysis) -> Spans:
    """Return what to record to identify the carts, or why they cannot be identified."""
    for skip in reversed(analysis.skipped):
        if skip.stage is Stage.FINAL_ESTIMATES:
            if skip.missing:
                return _WORDS.spans("do_record_for_fit", missing=skip.missing)
            return _WORDS.spans("do_identify", reason=_sentence(clean(skip.reason)))
    return _WORDS.spans("do_fit_identified")


def _names(checks: Sequence[Check]) -> Spans:
    """Return the names of failed checks as in the report's table."""
    abouts = [clean(check.about) for check in checks if check.about]
    if len(checks) == 1 or len(abouts) < len(checks):
        return spans(Span(", ".join(clean(check.id) for check in checks), "code"))
    return spans(Span(f"{clean(checks[0].kind)}: {', '.join(abouts)}", "code"))


def _sentence(text: str) -> str:
    return text if text.endswith((".", "?", "!")) else f"{text}."


def _advice(analysis: Analysis) -> Iterator[Spans]:
    """Yield further advice that does not come from a failed check."""
    say, fit, design = _WORDS.spans, analysis.fit, analysis.feedback
    asked = {_group(check) for check in analysis.failed_checks}
    if analysis.unread:
        yield say("next_unread", lines=rich(clean("; ".join(analysis.unread[:_MOST_TOLD]))))
    if wrong := list(dict.fromkeys(reported_off(analysis))):
        yield say("next_reported", names=names_spans(wrong))
    if short := sorted({point.experiment for point in analysis.sine_points if not point.settled}):
        yield say("next_short", runs=clean(listing(short)))
    doubted = {check.experiment for check in analysis.hardware if check.contradicted}
    poor = [c for c in analysis.hardware if c.nrmse > CLOSE and c.experiment not in doubted]
    left = poor or (fit is not None and not fit.explains_data)
    if left and "fit_explains_data" not in asked:
        yield say("do_fit_explains_data")
    to_run = design is not None and not any(r.kind == "closed_loop" for r in analysis.records)
    if to_run:
        yield say("next_run")
    # Missing recordings are mentioned only if the carts are identified and no recording needs
    # fixing.
    if fit is not None and not asked & {"data", "record"}:
        run = {Stage.HARDWARE_CHECK} if to_run else frozenset[Stage]()
        lacking = [skip for skip in analysis.skipped if skip.stage not in run]
        missing = dict.fromkeys(skip.missing for skip in lacking if skip.missing)
        if missing:
            yield say("next_missing", missing=rich(clean(listing(list(missing)))))
    if design and not design.reachable:
        yield say("next_goal", message=clean(design.message))


def _nothing_left(analysis: Analysis) -> Spans:
    return _WORDS.spans("next_warnings" if analysis.warnings else "next_nothing")


def set_up_in_doubt(analysis: Analysis) -> tuple[bool, Spans] | None:
    """Return the problems that make every number wrong, as one finding, None without problems.

    The summary shows this finding first.
    """
    wrong = [check for check in analysis.failed_checks if _group(check) in _AT_THE_TOP]
    if not wrong:
        return None
    sentences = (
        _WORDS.spans(f"top_{_group(c)}", message=_sentence(clean(c.message))) for c in wrong
    )
    return False, tuple(span for one in sentences for span in (*one, Span(" ")))[:-1]
