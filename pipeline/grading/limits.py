"""The decision limits of grading, each with its reason; shared recordings have their own.

Their combined effect is measured on simulated benches of all kinds: honest teams get no flag, and
at least nine of ten planted mistakes are named (`tests/statistics/test_grading.py`,
`benchmarks/grading.py`). Shares are relative; "high over low" refers to a reference's bounds.
"""

from fractions import Fraction

# ------------------------------------------------ how far the values of the recordings are trusted

# Factors: beyond them between a fitted and a measured frequency or gain, the fit is wrong.
ASTRAY, ASTRAY_GAIN = 1.3, 1.6
STUCK = 1.2  # factor: for a gain of carts that stick too much for a linear fit
FOLLOWED_SHARE = 0.9  # this share of recordings must follow the identified carts
STILL = 3.0  # encoder steps: a cart that moved less was held by friction
ONE_NUMBER = 1.03  # factor: bounds this close are shown as one number
# Factors: beyond them no student believes a fit. Also, if no linear carts move like the recordings,
# no method of finding a number errs by more; dampings can then have any value.
BEYOND_BELIEF, BEYOND_BELIEF_DAMPING = 2.5, 20.0
FITTED_TO_NOTHING = 10.0  # factor: the same for a final gain, fitted to data without a good fit
SAME_STEP = 0.2  # relative: two steps that count as the same size
BY_SIZE = 1.1  # factor: if gains differ more between step sizes, each size has its own
READ_BY_EYE = 1.1  # factor: a resonance or null read off the dwells

# ------------------------------------------------------ errors that are worth a remark, in percent

# Careful teams on one bench differ by a few percent in gains and frequencies. The paper's own
# tables differ by up to 14 % (29 % at a null read by eye), and dampings by half and more.
OFF_FINAL, OFF_INITIAL, OFF_BY_EYE, OFF_DAMPING = 7.0, 10.0, 30.0, 80.0
SUSPECT_DAMPING = 40.0  # enough to search for a known mistake, not for a remark
OFF_EACH_OTHER = 25.0  # somewhat more than the errors allowed in both tables
CONFIRMED = 0.05  # share: within it the other table agrees
SIGMAS = 3.0  # standard errors of the recordings' value that are not a mistake

# --------------------------------- how closely a mistake must reproduce a number, as a share of it

READ = 0.03  # for a gain or frequency: an honest reading after one mistake
TURN_READ = 0.015  # for a turning point, which is sharper than a settled level
COUNTED = 0.02  # for a frequency from counted periods, whose peaks are sharper
BLURRED = 0.05  # for a gain of carts that stick
DAMPING = 0.2
LOG10_DAMPING = 0.3  # wide, because no other damping mistake has a similar factor
UNMISTAKABLE, FAR = 0.1, 4.0  # for factors from `FAR` on, which no other mistake has
NEAR, NEAR_BY_EYE = 0.1, 0.3  # for an honest first estimate
TURN_OFF = 0.06  # an extremum this close to the gain does not prove a mistake

VAGUE = 3.0  # high over low: bounds so wide match any mistake and prove none
BLURRED_DAMPING = 1.3  # … such a damping cannot prove a miscounted period
SHARP = 1.05  # … a reference without friction is at least this sharp

# --------------------------------------------- likelihoods, to choose between several mistakes

# How far honest numbers lie outside their bounds: medians of the logarithm (Cauchy distribution).
USUAL_GAIN, USUAL_FREQUENCY, USUAL_BY_EYE, USUAL_DAMPING = 0.01, 0.004, 0.06, 0.2
ANYWHERE = 3.0  # e-folds over which an unexplained wrong number may lie
ONE_IN_OFF, ONE_IN_KNOWN = 20, 10  # one number in 20 is just wrong; one table in 10 has a mistake
ONE_OF_SEVERAL = 5  # a team that miscounts one decay miscounts all, except one team in 5
ODD = 20  # one team in 20 miscounts periods for ω but not for δ of the same peaks

# --------------------------------------------------------------------- the reduced table of ratios

SAME_FREQUENCY = 0.02  # relative: within it a row belongs to this dwell
MOST_ROWS, ENOUGH_ROWS = 0.8, 0.6  # share that a mistake must match; share that makes a table right
LEAST_COUNTS = 20.0  # encoder steps: smaller amplitudes cannot be read well

# ------------------------------------------------------------------------------- the state model

# Percent: above WRONG an entry is wrong rather than imprecise; a named mistake must match within
# EXPLAINED. Couplings are differences of large numbers, and friction adds to dampings.
WRONG = {"exact": 0.0, "stiffness": 20.0, "damping": 100.0}
EXPLAINED = {"exact": 0.0, "stiffness": 12.0, "damping": 60.0}
EXACT = 1e-6  # rounding allowed in a 0 or 1 of A: 1.2e-17 is zero
# Standard errors of an honest table, and how many of them its A and B may differ: two ways from the
# table to the same coupling differ by as much.
HONEST, HONEST_DAMPING, HONEST_SIGMAS = 0.01, 0.1, 2.0

# --------------------------------------------------------------- harmful models and controllers

# A model or controller that would break the bench, or move it the wrong way, keeps at most this
# share of its criterion: its other numbers are then useless.
KEPT_IF_HARMFUL = Fraction(1, 4)

# -------------------------------------------------------------------------------- the controller

# Beyond these limits a controller is wrong; below, taste or the model's error can explain it.
OVERSHOOT, SETTLING = 20.0, 2.0  # percentage points above the goal; times the goal
CLAIM_OVERSHOOT, CLAIM_SETTLING = 12.0, 1.6
PREFILTER, PREFILTER_BLURRED = 0.10, 0.20
PREFILTER_SIGMAS = 2.0  # standard errors of the fitted static gains that a prefilter may differ by
