"""The decision limits of grading, each with its reason.

The limits for shared recordings are in `similarity`. The combined effect of all limits is measured
on simulated benches of all kinds: honest teams get no flag, and at least nine of ten planted
mistakes are named (`tests/statistics/test_grading.py`, `benchmarks/grading.py`).

Shares are relative. "High over low" is the ratio of a reference's bounds.
"""

from fractions import Fraction

# ------------------------------------------------ how far the values of the recordings are trusted

# Factors: if a fitted frequency or gain differs more than this from the measured one, the fit is
# wrong.
ASTRAY, ASTRAY_GAIN = 1.3, 1.6
STUCK = 1.2  # factor: widens the bounds of gains if carts stick too much for a linear fit
FOLLOWED_SHARE = 0.9  # share of the recordings that a trusted chain must reproduce
STILL = 3.0  # encoder steps: if a cart moved less, friction held it
ONE_NUMBER = 1.03  # factor: a reference whose bounds differ less is shown as one number
# Factors: a student who sees a larger difference does not believe the fit. They also bound every
# method if no linear carts move like the recordings; dampings can then have any value.
BEYOND_BELIEF, BEYOND_BELIEF_DAMPING = 2.5, 20.0
FITTED_TO_NOTHING = 10.0  # factor: the same for a final gain if no fit to the data is good
SAME_STEP = 0.2  # relative difference at which two steps count as the same size
BY_SIZE = 1.1  # factor: if gains for different step sizes differ more, each size has its own gain
READ_BY_EYE = 1.1  # factor: error of a resonance or null that is read off the dwells

# ------------------------------------------------------ errors that are worth a remark, in percent

# Careful teams on one bench differ by a few percent in gains and frequencies, and by half or more
# in dampings. The paper's own tables differ by up to 14 %, and by 29 % at a null read by eye.
OFF_FINAL, OFF_INITIAL, OFF_BY_EYE, OFF_DAMPING = 7.0, 10.0, 30.0, 80.0
# Percent: above this, a damping is compared with known mistakes but gets no flag yet.
SUSPECT_DAMPING = 40.0
# Percent between the two tables: a little more than the errors allowed in each.
OFF_EACH_OTHER = 25.0
CONFIRMED = 0.05  # share: a number in the other table that differs by less confirms this one
SIGMAS = 3.0  # standard errors of the recordings' value; a smaller difference is no mistake

# --------------------------------- how closely a mistake must reproduce a number, as a share of it

READ = 0.03  # for gains and frequencies that were read carefully, apart from the mistake
TURN_READ = 0.015  # for turning points, which can be read more precisely than a settled level
COUNTED = 0.02  # for frequencies from counted periods, because peaks can be read precisely
BLURRED = 0.05  # for gains of carts that stick
DAMPING = 0.2
LOG10_DAMPING = 0.3  # wide, because no other mistake changes a damping by a similar factor
# Tolerance for mistakes with a factor of at least `FAR`; no other mistake has so large a factor.
UNMISTAKABLE, FAR = 0.1, 4.0
# For the other numbers of the table, which may be honest first estimates.
NEAR, NEAR_BY_EYE = 0.1, 0.3
TURN_OFF = 0.06  # share: a turning point this close to the gain proves no mistake

VAGUE = 3.0  # high over low: wider bounds match any mistake and so prove none
BLURRED_DAMPING = 1.3  # high over low: a damping with wider bounds cannot prove a miscounted period
SHARP = 1.05  # high over low: the largest ratio for a reference without friction

# --------------------------------------------- likelihoods, to choose between several mistakes

# How far honest numbers lie outside their bounds: the median of the logarithm (Cauchy
# distribution).
USUAL_GAIN, USUAL_FREQUENCY, USUAL_BY_EYE, USUAL_DAMPING = 0.01, 0.004, 0.06, 0.2
ANYWHERE = 3.0  # e-folds; an unexplained wrong number may lie anywhere in so wide a range
# One number in 20 is simply wrong; one table in 10 has a known mistake.
ONE_IN_OFF, ONE_IN_KNOWN = 20, 10
ONE_OF_SEVERAL = 5  # a team that miscounts one decay miscounts all of them, except one team in 5
# One team in 20 miscounts periods for ω but not for δ, although both come from the same peaks.
ODD = 20

# --------------------------------------------------------------------- the reduced table of ratios

SAME_FREQUENCY = 0.02  # relative difference at which a row and a dwell have the same frequency
# Share of rows that a mistake must reproduce, and share of right rows that makes a table right.
MOST_ROWS, ENOUGH_ROWS = 0.8, 0.6
LEAST_COUNTS = 20.0  # encoder steps: smaller amplitudes cannot be read precisely

# ------------------------------------------------------------------------------- the state model

# Percent: an entry with an error above WRONG is wrong, not just imprecise; a named mistake must
# give the entry within EXPLAINED. Couplings are differences of large numbers, and friction adds to
# dampings.
WRONG = {"exact": 0.0, "stiffness": 20.0, "damping": 100.0}
EXPLAINED = {"exact": 0.0, "stiffness": 12.0, "damping": 60.0}
EXACT = 1e-6  # rounding allowed in a 0 or 1 of A: 1.2e-17 counts as zero
# Standard errors of the numbers in an honest table, and how many of them A and B may differ from
# it. Two ways to compute the same coupling from a table differ by as much.
HONEST, HONEST_DAMPING, HONEST_SIGMAS = 0.01, 0.1, 2.0

# --------------------------------------------------------------- harmful models and controllers

# Some models and controllers would break the bench or move it the wrong way. Their criterion keeps
# at most this share of its points, because the other numbers are then useless.
KEPT_IF_HARMFUL = Fraction(1, 4)

# -------------------------------------------------------------------------------- the controller

# Beyond these limits a controller is wrong. Below, taste or the model's error can explain the
# difference.
OVERSHOOT, SETTLING = 20.0, 2.0  # percentage points above the goal; factor on the goal
CLAIM_OVERSHOOT, CLAIM_SETTLING = 12.0, 1.6
PREFILTER, PREFILTER_BLURRED = 0.10, 0.20
PREFILTER_SIGMAS = 2.0  # standard errors of the fitted static gains by which a prefilter may differ
