"""The grading in words: what each flag is called, and where a student looks."""

from pipeline.report.document import Tone
from pipeline.schemas.grade import Code, Outcome

TITLES: dict[Code, str] = {
    "hz_for_rad_s": "Hz where rad/s is asked",
    "peak_count": "periods miscounted",
    "peak_for_steady_state": "peak in place of the steady state",
    "peak_to_peak": "peak-to-peak in place of the amplitude",
    "transient_used": "a sine read before it was steady",
    "carts_swapped": "carts swapped",
    "counts_for_length": "counts in place of a length",
    "log10_for_ln": "log10 in place of the natural logarithm",
    "no_fit_done": "final values copied from the initial ones",
    "final_off": "a final value that the recordings do not give",
    "initial_off": "an initial value that the recordings do not give",
    "initial_final_disagree": "initial and final values disagree",
    "physically_impossible": "values that no real carts have",
    "wrong_state_space": "an error in the state model",
    "wrong_gains": "feedback gains that do not do what they should",
    "wrong_prefilter": "an error in the prefilter",
    "missing": "something is missing",
    "shared_data": "a recording that another submission has too",
    "data_problem": "a recording that does not hold what it should",
}
PLACES: dict[Code, str] = {
    "hz_for_rad_s": "the unit of every frequency in your table; one Hz is 2π rad/s.",
    "peak_count": "your decay: from the first peak to the n-th there are n − 1 periods.",
    "peak_for_steady_state": "your step: the level it settles at, not how far it first swings.",
    "peak_to_peak": "your sine dwells: the amplitude is half of the distance between the peaks.",
    "transient_used": "the start of each sine dwell: wait until the swing no longer changes.",
    "carts_swapped": "which encoder belongs to which cart; cart 1 is the one that is driven.",
    "counts_for_length": "the calibration: encoder counts times the length of one count.",
    "log10_for_ln": "the log decrement: it is the natural logarithm, ln, of the ratio.",
    "no_fit_done": "the Bode fit: its values come out close to the initial ones, not the same.",
    "final_off": "the figures below: your curve should pass through your measured points.",
    "initial_off": "the decay or step that the value was read from.",
    "initial_final_disagree": "both ways to the number; one of them went astray.",
    "physically_impossible": "the order of the frequencies, and every sign.",
    "wrong_state_space": "each entry of A and B, from the table of final values.",
    "wrong_gains": "the gains on the carts of your own table: the poles, then a step.",
    "wrong_prefilter": "the prefilter: one over the static gain of the closed loop.",
    "missing": "the list of what the laboratory asks for.",
    "shared_data": "the files you handed in; a mix-up is easily made. Talk to your instructor.",
    "data_problem": "the recording itself, plotted over its whole length.",
}
OUTCOMES: dict[Outcome, str] = {
    "pass": "passed",
    "partial": "in part",
    "fail": "not passed",
    "skip": "not checked",
}
TONES: dict[Outcome, Tone] = {"pass": "good", "partial": "", "fail": "bad", "skip": "quiet"}


def points_text(points: float) -> str:
    """Return points to the hundredth, without zeros that say nothing."""
    return f"{points:.2f}".rstrip("0").rstrip(".")
