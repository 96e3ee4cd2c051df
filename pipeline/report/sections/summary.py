"""The summary: what was identified, what agrees, what does not, and what to do next."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from pipeline.identify.groups import group_name
from pipeline.names import MODES, read_name
from pipeline.report.builder import Page
from pipeline.report.document import (
    Block,
    Items,
    Tile,
    Tiles,
    Tone,
    bullet_list,
    paragraph,
    plain_lines,
)
from pipeline.report.sections.housekeeping import taken_text
from pipeline.report.sections.loops import CLOSE
from pipeline.report.sections.measurements import overview_blocks
from pipeline.report.sections.questions import Asked, misspelt_headings, unanswered
from pipeline.results import Analysis, Check, HardwareCheck, ParameterRow, Stage
from pipeline.words.numbers import (
    NOTHING,
    count,
    listing,
    percent,
    share,
    significant,
    unit_text,
    with_error,
)
from pipeline.words.phrases import phrases
from pipeline.words.text import (
    Span,
    Spans,
    clean,
    name_span,
    names_spans,
    plain,
    rich,
    sentence,
    spans,
)

_WORDS = phrases("summary")
_KINDS = {  # names for kinds of recordings
    "decay": "decay",
    "step": "step",
    "sine": "sine dwell",
    "sweep": "sweep",
    "closed_loop": "closed-loop recording",
    "bode": "table of amplitude ratios",
}
_MOST_TOLD = 3  # most findings of one kind, or messages of one group of checks
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


@dataclass(frozen=True)
class _Finding:
    """A sentence on what was found, whether it is good news, and its tile if it has one."""

    good: bool
    text: Spans
    tile: Tile | None = None


def summary(page: Page, *, open_questions: Sequence[Asked] = ()) -> list[Block]:
    """Return what was identified, what agrees, what does not, what is missing, and what to do next.

    Results are shown on boards of tiles. Problems are also described in sentences. One picture
    shows all carts.

    Parameters
    ----------
    open_questions : the questions that the students have not answered.
    """
    analysis = page.analysis
    blocks: list[Block] = [_identified(analysis)]
    findings = _findings(analysis)
    verdicts = [
        _status_tile(analysis),
        *_fit_tile(analysis),
        *(one.tile for one in findings if one.tile),
    ]
    if numbers := _numbers_board(analysis):
        blocks += [Tiles(numbers, across=3), paragraph(_board_legend(analysis))]
    blocks.append(Tiles(tuple(verdicts)))
    if problems := [one.text for one in findings if not one.good]:
        blocks.append(bullet_list(problems))
    blocks += overview_blocks(page)
    steps = next_steps(analysis, open_questions=open_questions, has_links=True)
    return [*blocks, paragraph(Span(_WORDS.text("next"), "strong")), steps]


def terminal_summary(analysis: Analysis) -> str:
    """Return the summary as lines of text: a paragraph, a finding or a step is one line."""
    numbers = [
        f"{plain(tile.label)} = {plain(tile.value)} {tile.unit}".rstrip()
        for tile in _numbers_board(analysis)
    ]
    it_has = [paragraph(f"{_WORDS.text('it_has')} {'; '.join(numbers)}.")] if numbers else []
    findings = bullet_list(one.text for one in _findings(analysis))
    steps = next_steps(analysis, open_questions=unanswered(analysis))
    next_ = [paragraph(f"{_WORDS.text('next')}."), steps]
    return plain_lines([_identified(analysis), *it_has, findings, *next_])


def _findings(analysis: Analysis) -> list[_Finding]:
    """Return what was found, in the order of the report; all that makes numbers wrong first."""
    found = (
        _set_up_in_doubt,
        _groups,
        _assumed,
        _agreement,
        _undecided,
        _checks,
        _friction,
        _design,
        _hardware,
        _skipped,
    )
    return [finding for of in found if (finding := of(analysis))]


def _identified(analysis: Analysis) -> Block:
    single, fit = analysis.bench.n == 1, analysis.fit
    carts = _WORDS.text("one_cart" if single else "carts", n=analysis.bench.n)
    if fit is None:
        unused = {one.experiment for one in analysis.left_out}
        used = _runs(analysis, [r.id for r in analysis.records if r.id not in unused])
        source = _WORDS.text("from_runs" if used else "from_data", runs=used)
        reasons = _WORDS.spans("reasons") if analysis.skipped else ""
        return paragraph(
            _WORDS.spans("not_identified", carts=carts, source=source, reasons=reasons)
        )
    used = _runs(analysis, fit.experiments)
    failed = "" if fit.converged else _WORDS.text("not_converged", message=clean(fit.message))
    return paragraph(
        _WORDS.spans(
            "identified" if fit.converged else "fit_failed",
            carts=carts,
            source=_WORDS.text("from_runs" if used else "from_data", runs=used),
            fit=_WORDS.text("one_fit" if single else "joint_fit"),
            what=_WORDS.text(fit.method),
            points=str(fit.n_points),
            quality=_WORDS.text("explained" if fit.explains_data else "unexplained")
            if fit.converged
            else "",
            first=_first_estimates(analysis, fitted_to=fit.experiments),
            failed=failed,
        )
    )


def _first_estimates(analysis: Analysis, *, fitted_to: Sequence[str]) -> str:
    """Return the recordings that gave initial estimates; "" if nothing was measured."""
    runs = dict.fromkeys(
        run for row in analysis.rows if row.initial for run in row.initial.experiments
    )
    others = [run for run in runs if run not in fitted_to]
    if not runs:
        return ""
    if not others:
        return _WORDS.text("first_same")
    key = "first_others" if len(others) == len(runs) else "first_both"
    return _WORDS.text(key, runs=_runs(analysis, others))


def _runs(analysis: Analysis, ids: Collection[str]) -> str:
    """Return the number of recordings of each kind; tables are counted as a separate kind."""
    known = {record.id: record.kind for record in analysis.records}
    kinds = Counter(known.get(id_, "bode") for id_ in dict.fromkeys(ids))
    return listing([count(kinds[kind], noun) for kind, noun in _KINDS.items() if kinds[kind]])


@dataclass(frozen=True)
class _NumberTile(Tile):
    """A tile of a parameter; `unit` is its unit."""

    unit: str = ""


def _numbers_board(analysis: Analysis) -> tuple[_NumberTile, ...]:
    """Return the gain, the resonance and its damping ratio of each cart or mode, row by row."""
    n = analysis.bench.n
    rows = [
        row
        for row in analysis.rows
        if row.final and (n == 1 or (name := read_name(row.name)).is_gain or name.is_mode)
    ]
    place = {row.name: i for i, row in enumerate(rows)}
    order = sorted(rows, key=lambda row: (_mode(row.name), place[row.name]))
    return tuple(_number_tile(row, is_sure=_is_explained(analysis)) for row in order)


def _mode(name: str) -> int:
    """Return the number of a mode or cart: 0 for "K_1" and "zeta_a"."""
    read = read_name(name)
    return (read.cart or 1) - 1 if read.is_gain else max(0, MODES.find(read.suffix))


def _board_legend(analysis: Analysis) -> str:
    """Return what the numbers on the board mean."""
    shown = [row for row in analysis.rows if row.final]
    both = any(row.initial for row in shown)
    keys = ["board_both" if both else "board_final"]
    if _is_explained(analysis):
        keys.append("statistical_only")
    return " ".join(_WORDS.text(key) for key in keys)


def _is_explained(analysis: Analysis) -> bool:
    """Return whether the standard errors are valid, because the residual is only noise."""
    return analysis.fit is not None and analysis.fit.explains_data


def _number_tile(row: ParameterRow, *, is_sure: bool) -> _NumberTile:
    """Return a tile with the initial and the final value, and the final one's error as a share.

    If the true error is unknown, the values have only three digits.
    """
    final, initial, unit = row.final, row.initial, unit_text(clean(row.unit))
    assert final is not None
    digits, notes = 3, [unit]
    if row.extrapolated:
        notes.append(_WORDS.text("extrapolated"))
    elif is_sure and final.std and final.value:
        digits = 4
        notes.append(f"± {share(final.std / abs(final.value))}")
    value = significant(final.value, digits=digits)
    if initial is not None:
        is_guess = initial.source == "assumed"
        value = f"{significant(initial.value, digits=2 if is_guess else digits)} → {value}"
        if is_guess:
            notes.append(_WORDS.text("guessed"))
    return _NumberTile(
        spans(name_span(row.name)), spans(value), spans(", ".join(filter(None, notes))), unit=unit
    )


def _status_tile(analysis: Analysis) -> Tile:
    status = analysis.status
    url = "#parameters" if status.state == "numbers_disagree" else "#checks"
    url = url if analysis.checks else "#skipped" if analysis.skipped else ""
    return _tile("tile_status", status.words, "", good=status.is_fine, url=url)


def _fit_tile(analysis: Analysis) -> list[Tile]:
    """Return how much of the motion the model leaves, with a link to the figures that show it."""
    fit, left = analysis.fit, analysis.unexplained_share
    if fit is None or left is None:
        return []
    good = fit.converged and fit.explains_data
    url = "#frequency-response" if analysis.frequency_responses else "#parameters"
    note = _WORDS.text("tile_explained" if good else "tile_unexplained")
    return [_tile("tile_fit", share(left), note, good=good, url=url)]


def _tile(key: str, value: str, note: str, *, good: bool, url: str) -> Tile:
    return Tile(spans(_WORDS.text(key)), spans(value), spans(note), _tone(good), url)


def _tally(key: str, note: str, *, good: int, of: int, url: str) -> Tile:
    return _tile(key, f"{good} of {of}", _WORDS.text(note), good=good == of, url=url)


def _tone(good: bool) -> Tone:
    return "good" if good else "bad"


def _assumed(analysis: Analysis) -> _Finding | None:
    """Return, as a finding, the default assumptions that the data neither support nor refute."""
    taken = [a for a in analysis.assumptions if a.origin == "default" and a.support == "open"]
    if not taken:
        return None
    items = [clean(f"{f'{one.key} {one.about}'.strip()} ({taken_text(one)})") for one in taken]
    return _Finding(False, _WORDS.spans("assumed", taken=listing(items)))


def _groups(analysis: Analysis) -> _Finding | None:
    """Return the names of the groups of recordings that contradict each other, as one finding."""
    if not analysis.groups:
        return None
    names = [f"({i}) {group_name(group)}" for i, group in enumerate(analysis.groups, start=1)]
    return _Finding(False, _WORDS.spans("groups", groups=clean("; ".join(names))))


def _agreement(analysis: Analysis) -> _Finding | None:
    judged = [row for row in analysis.rows if row.consistent is not None]
    if not judged:
        return None
    off, same = [row for row in judged if not row.consistent], _same_recordings(judged)
    rest = len(judged) - len(off)
    note = "tile_disagree" if off else "tile_agree"
    tile = _tally("tile_two_ways", note, good=rest, of=len(judged), url="#parameters")
    key, n = ("rest", rest) if off and rest else ("no_rest" if off else "agree", len(judged))
    key, parameters = key if n > 1 else f"{key}_one", count(n, "parameter")
    if not off:
        return _Finding(True, _WORDS.spans(key, parameters=parameters, same=same), tile)
    changes = [f"{row.name} ({percent(row.change_percent, signed=True)})" for row in off]
    text = _WORDS.text(key, parameters=parameters)
    told = _WORDS.spans("disagree", changes=rich(listing(changes)), rest=text, same=same)
    return _Finding(False, told, tile)


def _same_recordings(judged: Sequence[ParameterRow]) -> Spans:
    """Return a sentence on parameters whose two estimates come from the same recordings."""
    same = [row.name for row in judged if row.independent is False]
    if not same:
        return ()
    if len(same) == len(judged):
        return _WORDS.spans("all_same")
    return _WORDS.spans("some_same", names=names_spans(same))


def _undecided(analysis: Analysis) -> _Finding | None:
    """Return, as a finding, the parameters that were measured twice with different results.

    Without this finding, the number on the board would look certain.
    """
    names = [
        _WORDS.text(
            "undecided_one",
            name=row.name,
            initial=with_error(row.initial.value, row.initial.std),
            final=with_error(row.final.value, row.final.std),
        )
        for row in analysis.rows
        if row.consistent is None and row.change_sigmas is not None and row.initial and row.final
    ]
    if not names:
        return None
    return _Finding(False, _WORDS.spans("undecided", parameters=rich(listing(names))))


def _checks(analysis: Analysis) -> _Finding | None:
    done = [c for c in analysis.checks if c.outcome != "skip"]
    failed = analysis.failed_checks
    if not done:
        return None
    passed = sum(check.outcome == "pass" for check in done)
    checks = count(len(done), "check")
    tile = _tally("tile_checks", "tile_passed", good=passed, of=len(done), url="#checks")
    if not failed:
        return _Finding(True, _WORDS.spans("consistent", checks=checks), tile)
    told = _WORDS.spans("inconsistent", failed=str(len(failed)), checks=checks)
    return _Finding(False, told, tile)


def _friction(analysis: Analysis) -> _Finding | None:
    """Return, as a finding, the decays and the steps whose ringing shows dry friction."""
    shown = [d for d in analysis.log_decrements if d.law.is_friction]
    if not shown:
        return None
    places = []
    for key in ("decays_of", "ringing_of"):
        of_kind = [d for d in shown if (d.experiment in analysis.steps) == (key == "ringing_of")]
        if of_kind:
            carts = _carts(sorted({d.cart for d in of_kind}))
            runs = listing(list(dict.fromkeys(d.experiment for d in of_kind)), most=_MOST_TOLD)
            places.append(_WORDS.text(key, carts=carts, runs=clean(runs)))
    return _Finding(False, _WORDS.spans("friction", where=listing(places)))


def _design(analysis: Analysis) -> _Finding | None:
    design = analysis.feedback
    if design is None:
        return None
    settling, good = design.settling_time, design.reachable
    seconds, overshoot = significant(settling, digits=3), percent(design.overshoot_percent)
    told = _WORDS.spans(
        "feedback",
        cart=str(design.cart),
        verdict=_WORDS.text("met" if good else "not_met"),
        settles=_WORDS.text("never_settles" if settling is None else "settles", seconds=seconds),
        overshoot=overshoot,
    )
    verdict = "met" if good else "not met"
    note = _WORDS.text("tile_settles", overshoot=overshoot, verdict=verdict)
    label = _WORDS.text("tile_feedback", cart=design.cart)
    # The goal is met on the model, which promises little if it does not explain the data.
    tone = _tone(good) if _is_explained(analysis) or not good else ""
    value = f"{seconds} s" if settling else NOTHING
    tile = Tile(spans(label), spans(value), spans(note), tone, "#feedback")
    return _Finding(good, told, tile)


def _hardware(analysis: Analysis) -> _Finding | None:
    if not analysis.hardware:
        return None
    ordered = sorted(analysis.hardware, key=lambda check: check.nrmse)
    best, worst = ordered[0], ordered[-1]
    good, note = worst.nrmse <= CLOSE, _WORDS.text("tile_apart")
    value = _range(best, worst, to="–")
    told = _WORDS.spans(
        "hardware",
        range=_range(best, worst, to=" to "),
        cart=str(worst.cart),
        run=clean(worst.experiment),
    )
    return _Finding(good, told, _tile("tile_hardware", value, note, good=good, url="#hardware"))


def _range(best: HardwareCheck, worst: HardwareCheck, *, to: str) -> str:
    low, high = percent(100 * best.nrmse), percent(100 * worst.nrmse)
    return low if low == high else f"{low.removesuffix(' %')}{to}{high}"


def _skipped(analysis: Analysis) -> _Finding | None:
    if not analysis.skipped:
        return None
    names = list(dict.fromkeys(clean(skip.name) for skip in analysis.skipped))
    more = len(names) - _MOST_TOLD
    # Semicolons, because names contain commas: "log decrement, decay-1, cart 1".
    stages = "; ".join(names[:_MOST_TOLD] + ([f"{more} more"] if more > 0 else []))
    return _Finding(False, _WORDS.spans("skipped", stages=stages))


def _carts(carts: list[int]) -> str:
    word = "cart" if len(carts) == 1 else "carts"
    return f"{word} {listing([str(cart) for cart in carts])}"


# ------------------------------------------------------------------------------- what to do next


def next_steps(
    analysis: Analysis, *, open_questions: Sequence[Asked] = (), has_links: bool = False
) -> Items:
    """Return what to do about every failed check, the most serious first, and further advice.

    Parameters
    ----------
    open_questions : the questions that the students have not answered.
    has_links : whether the questions are on the same page.
    """
    steps = [*_unread(analysis), *_failed(analysis), *_advice(analysis)]
    if open_questions:
        steps.append(_to_answer(analysis, open_questions, has_links=has_links))
    return bullet_list(steps or [_nothing_left(analysis)])


def _to_answer(analysis: Analysis, asked: Sequence[Asked], *, has_links: bool) -> Spans:
    """Return which questions to answer, and which headings of the notes nearly name one."""
    ids: list[Span] = []
    for one in asked:
        url = f"#question-{one.id}" if has_links else ""
        ids += [Span(", " if ids else ""), Span(one.id, "code", url=url)]
    nearly = "".join(
        _WORDS.text("next_misspelt", heading=clean(heading), id=id_)
        for heading, id_ in misspelt_headings(analysis, asked)
    )
    questions = count(len(asked), "question")
    return _WORDS.spans("next_answer", questions=questions, ids=tuple(ids), nearly=nearly)


def _unread(analysis: Analysis) -> Iterator[Spans]:
    """Yield which parts of submission.toml cannot be used, as failed checks may come from them."""
    if analysis.unread:
        lines = rich(clean("; ".join(analysis.unread[:_MOST_TOLD])))
        yield _WORDS.spans("next_unread", lines=lines)


def _failed(analysis: Analysis) -> Iterator[Spans]:
    groups: dict[str, list[Check]] = {}
    for check in analysis.failed_checks:
        groups.setdefault(_group(check), []).append(check)
    if "groups" in groups:  # recordings of different carts give different numbers
        groups["groups"] += groups.pop("repeats", [])
    for group in sorted(groups, key=_place):
        checks = sorted(groups[group], key=lambda check: check.excess, reverse=True)
        shown = checks[: 1 if group in _ALIKE else _MOST_TOLD]
        shown = [check for check in shown if check.kind == group] if group == "groups" else shown
        shown = () if group in _TOLD_ELSEWHERE else shown
        messages = dict.fromkeys(sentence(clean(check.message)) for check in shown)
        yield _WORDS.spans(
            "failed",
            action=_action(group, checks, analysis),
            told=rich("".join(f"{message} " for message in messages)),
            names=_names(groups[group]),
        )
        # Without a fit, correct springs come before new recordings.
        if group == "input_sign" or (group == "springs" and "fit_converged" in groups):
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
            return _WORDS.spans("do_identify", reason=sentence(clean(skip.reason)))
    return _WORDS.spans("do_fit_identified")


def _names(checks: Sequence[Check]) -> Spans:
    """Return the names of failed checks as in the report's table."""
    abouts = [clean(check.about) for check in checks if check.about]
    if len(checks) == 1 or len(abouts) < len(checks):
        return spans(Span(", ".join(clean(check.id) for check in checks), "code"))
    return spans(Span(f"{clean(checks[0].kind)}: {', '.join(abouts)}", "code"))


def _advice(analysis: Analysis) -> Iterator[Spans]:
    """Yield further advice that does not come from a failed check."""
    say, fit, design = _WORDS.spans, analysis.fit, analysis.feedback
    asked = {_group(check) for check in analysis.failed_checks}
    if analysis.reported_off:
        yield say("next_reported", names=names_spans([*analysis.reported_off]))
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


def _set_up_in_doubt(analysis: Analysis) -> _Finding | None:
    """Return the problems that make every number wrong, as one finding, None without problems.

    The summary shows this finding first.
    """
    wrong = [check for check in analysis.failed_checks if _group(check) in _AT_THE_TOP]
    if not wrong:
        return None
    sentences = (
        _WORDS.spans(f"top_{_group(c)}", message=sentence(clean(c.message))) for c in wrong
    )
    told = tuple(span for one in sentences for span in (*one, Span(" ")))[:-1]
    return _Finding(False, told)
