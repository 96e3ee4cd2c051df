"""The decision limits of grading, each with its reason.

The limits for shared recordings are in `similarity`. The combined effect of all limits is measured
on simulated benches of all kinds: honest teams get no flag, and at least nine of ten planted
mistakes are named (`tests/statistics/test_grading.py`, `benchmarks/grading.py`).

"High over low" is the upper bound of a reference divided by its lower bound.
"""

from fractions import Fraction

# ------------------------------------------------ how far the values of the recordings are trusted

# If a fitted frequency or gain differs from the measured one by more than this factor, the fit is
# wrong.
ASTRAY, ASTRAY_GAIN = 1.3, 1.6
STUCK = 1.2  # factor: widens the bounds of gains if carts stick too much for a linear fit
FOLLOWED_SHARE = 0.9  # share of the recordings that a trusted chain must reproduce
STILL = 3.0  # encoder steps: a cart that moved less was held by friction
ONE_NUMBER = 1.03  # factor: a reference with closer bounds is shown as one number
# A student who sees a difference by more than this factor does not believe the fit. On a nonlinear
# bench, all bounds are widened by these factors; dampings can then have almost any value.
BEYOND_BELIEF, BEYOND_BELIEF_DAMPING = 2.5, 20.0
FITTED_TO_NOTHING = 10.0  # factor: widens the bounds of a final gain on a nonlinear bench
SAME_STEP = 0.2  # relative difference at which two steps count as the same size
BY_SIZE = 1.1  # factor: if gains for two step sizes differ by more, each size has its own gain
# Factor: recordings whose numbers differ more from those of the team's bench are of another bench.
OTHER_BENCH, OTHER_BENCH_WITH_EFFECTS = 1.03, 1.1
READ_BY_EYE = 1.1  # factor: error of a resonance or null that is read off the dwells

# ------------------------------------------------------ errors that are worth a remark, in percent

# Careful teams on one bench differ by a few percent in gains and frequencies, and by half or more
# in dampings. The tables in Throne's paper differ by up to 14 %, and by 29 % at a null read by eye.
OFF_FINAL, OFF_INITIAL, OFF_BY_EYE, OFF_DAMPING = 7.0, 10.0, 30.0, 80.0
# Percent: a damping with a larger error is compared with known mistakes. It gets a flag of its own
# only above OFF_DAMPING.
SUSPECT_DAMPING = 40.0
# Percent of difference between the two tables: a little more than the error allowed in each.
OFF_EACH_OTHER = 25.0
CONFIRMED = 0.05  # relative difference: a closer number in the other table confirms this one
SIGMAS = 3.0  # standard errors of the value from the recordings; a smaller difference is no mistake

# --------------------------------- how closely a mistake must reproduce a number, as a share of it

READ = 0.03  # for gains and frequencies that were read carefully, apart from the mistake
TURN_READ = 0.015  # for turning points, which can be read more precisely than a settled level
COUNTED = 0.02  # for frequencies from counted periods, because peaks can be read precisely
BLURRED = 0.05  # for gains of carts that stick
DAMPING = 0.2
LOG10_DAMPING = 0.3  # wide, because no other mistake changes a damping by a similar factor
# Tolerance for mistakes that change a number by the factor `FAR` or more. It is wide, because no
# other mistake has so large a factor.
UNMISTAKABLE, FAR = 0.1, 4.0
# For other numbers that the mistake predicts; honest first estimates may be this far off.
NEAR, NEAR_BY_EYE = 0.1, 0.3
TURN_OFF = 0.06  # relative difference: a turning point this close to the gain proves no mistake

VAGUE = 3.0  # high over low: wider bounds match any mistake and so prove none
BLURRED_DAMPING = 1.3  # high over low: a damping with wider bounds cannot prove a miscounted period
SHARP = 1.05  # high over low: a reference with closer bounds is hardly affected by friction

# --------------------------------------------- likelihoods, to choose between several mistakes

# How far honest numbers lie outside their bounds: the median distance on a logarithmic scale, if
# the distances have a Cauchy distribution.
USUAL_GAIN, USUAL_FREQUENCY, USUAL_BY_EYE, USUAL_DAMPING = 0.01, 0.004, 0.06, 0.2
ANYWHERE = 3.0  # e-folds: the width of the range in which an unexplained wrong number may lie
# Assumed: one number in 20 is simply wrong, and one table in 10 has a known mistake.
ONE_IN_OFF, ONE_IN_KNOWN = 20, 10
ONE_OF_SEVERAL = 5  # of five teams that miscount one decay, four miscount all decays
# One team in 20 miscounts periods for ω but not for δ, although both come from the same peaks.
ODD = 20

# --------------------------------------------------------------------- the reduced table of ratios

SAME_FREQUENCY = 0.02  # relative difference: a row and a dwell this close have the same frequency
# Least share of rows that a mistake must reproduce, and least share of right rows in a right table.
MOST_ROWS, ENOUGH_ROWS = 0.8, 0.6
LEAST_COUNTS = 20.0  # encoder steps: smaller amplitudes cannot be read precisely

# ------------------------------------------------------------------------------- the state model

# Percent. An entry with an error above WRONG is wrong, not just imprecise. A known mistake explains
# an entry that it reproduces within EXPLAINED. Both limits are wide, because couplings are
# differences of large numbers, and friction adds to dampings.
WRONG = {"exact": 0.0, "stiffness": 20.0, "damping": 100.0}
EXPLAINED = {"exact": 0.0, "stiffness": 12.0, "damping": 60.0}
EXACT = 1e-6  # rounding allowed in a 0 or 1 of A: 1.2e-17 counts as zero
# Relative standard errors of frequencies, gains and dampings in an honest table. A and B may differ
# from the table by HONEST_SIGMAS times as much, as two ways to compute the same coupling do.
HONEST, HONEST_DAMPING, HONEST_SIGMAS = 0.01, 0.1, 2.0

# --------------------------------------------------------------- harmful models and controllers

# A model or controller that would break the bench or move it the wrong way earns at most this share
# of the points, because the rest of its numbers are then useless.
KEPT_IF_HARMFUL = Fraction(1, 4)

# -------------------------------------------------------------------------------- the controller

# Beyond these limits, a controller is wrong. Within them, an error of the model or a different
# choice by the designer can explain the difference.
OVERSHOOT, SETTLING = 20.0, 2.0  # percentage points, and factor, beyond the goal
CLAIM_OVERSHOOT, CLAIM_SETTLING = 12.0, 1.6
PREFILTER, PREFILTER_BLURRED = 0.10, 0.20
PREFILTER_SIGMAS = 2.0  # standard errors of the fitted static gains by which a prefilter may differ
