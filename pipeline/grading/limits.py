"""The decision limits of grading, each with its reason; those of shared recordings stand with them.

What they come to together is measured, on benches all over what a lab may have: no flag for honest
teams, the planted code for nine mistakes of ten and more (`tests/statistics/test_grading.py`,
`benchmarks/grading.py`). Shares are relative, "high over low" is of a reference's bounds.
"""

from fractions import Fraction

# ---------------------------------------- what the recordings say, and whether it is to be trusted

# A fitted frequency or gain that far from the measured one: the fit has gone astray; factors.
ASTRAY, ASTRAY_GAIN = 1.3, 1.6
STUCK = 1.2  # factor: a gain where carts stick so that no linear fit is near
FOLLOWED_SHARE = 0.9  # of the records follow carts that are identified, whatever points say
STILL = 3.0  # encoder steps: a cart that friction held
ONE_NUMBER = 1.03  # factor: bounds that near each other are one number to a reader
# Factors: a fit so far off leads no student astray; and where no linear carts move like the
# recordings, a number so far off comes of no way to find it. A damping is then anything.
BEYOND_BELIEF, BEYOND_BELIEF_DAMPING = 2.5, 20.0
FITTED_TO_NOTHING = 10.0  # factor: … of a final gain, which is fitted to what has no fit
SAME_STEP = 0.2  # relative: two steps that a bench treats alike
BY_SIZE = 1.1  # factor: gains of steps of two sizes that differ so much are told by the size
READ_BY_EYE = 1.1  # factor: a resonance or null read off the dwells

# ------------------------------------------------ from where on a number is worth a remark, percent

# Two careful teams on one bench differ by some percent in gains and frequencies, the paper's own
# tables by up to 14 % (29 % at a null read off by eye); dampings differ by half and more.
OFF_FINAL, OFF_INITIAL, OFF_BY_EYE, OFF_DAMPING = 7.0, 10.0, 30.0, 80.0
SUSPECT_DAMPING = 40.0  # enough to look for a known mistake, not for a remark of its own
OFF_EACH_OTHER = 25.0  # the sum of what the two tables may be off, and some more
CONFIRMED = 0.05  # share: the other table says the same
SIGMAS = 3.0  # standard errors of the recordings' own number that are no mistake

# ---------------------------------------------- how near a mistake must come to a number, as share

READ = 0.03  # of a gain or frequency: an honest reading after one slip
TURN_READ = 0.015  # of where a cart turns, which is sharper than where it settles
COUNTED = 0.02  # of a frequency by counted periods: peaks are sharper than a whole reading
BLURRED = 0.05  # of a gain where the carts stick
DAMPING = 0.2
LOG10_DAMPING = 0.3  # beside which no other mistake of a damping lies as near
UNMISTAKABLE, FAR = 0.1, 4.0  # by a factor that is nothing else's, from so much on
NEAR, NEAR_BY_EYE = 0.1, 0.3  # an honest first estimate, with a mistake in it or without
TURN_OFF = 0.06  # another extremum of the step as near to a gain as this says nothing

VAGUE = 3.0  # high over low: what any mistake would meet tells of none
BLURRED_DAMPING = 1.3  # … such a damping tells no story of a period miscounted
SHARP = 1.05  # … a reference that friction does not blur

# ------------------------------------------- which of several mistakes is believed: likelihoods

# How far honest numbers lie outside their bounds: half of the logarithms of them by less (Cauchy).
USUAL_GAIN, USUAL_FREQUENCY, USUAL_BY_EYE, USUAL_DAMPING = 0.01, 0.004, 0.06, 0.2
ANYWHERE = 3.0  # e-folds in which a number lies that is off and nothing explains
ONE_IN_OFF, ONE_IN_KNOWN = 20, 10  # numbers off with nothing to explain it; tables with a mistake
ONE_OF_SEVERAL = 5  # who miscounts one decay miscounts the others; once in so many not
ODD = 20  # a period miscounted for ω alone, where δ is of the same peaks: one in so many

# --------------------------------------------------------------------- the reduced table of ratios

SAME_FREQUENCY = 0.02  # a row of the table is of this dwell
MOST_ROWS, ENOUGH_ROWS = 0.8, 0.6  # met by a slip; met as they stand: right but for odd rows
LEAST_COUNTS = 20.0  # encoder steps: smaller amplitudes are not read well

# ------------------------------------------------------------------------------- the state model

# From here on an entry is wrong rather than imprecise, and a named slip must come as near: percent.
# Couplings are differences of large numbers, dampings are what friction adds to.
WRONG = {"exact": 0.0, "stiffness": 20.0, "damping": 100.0}
EXPLAINED = {"exact": 0.0, "stiffness": 12.0, "damping": 60.0}
EXACT = 1e-6  # a 0 or 1 of A is met within what a computer adds to it: 1.2e-17 is zero
# Standard errors of an honest table's numbers, and how many of them its A and B may lie off: two
# routes from the table to one coupling part by as much.
HONEST, HONEST_DAMPING, HONEST_SIGMAS = 0.01, 0.1, 2.0

# ----------------------------------------------------------------- what wrong numbers come to

# At most so much of a criterion is kept by a model or a controller that would break the bench, or
# move it the wrong way: all its other numbers are of no use then.
KEPT_IF_HARMFUL = Fraction(1, 4)

# -------------------------------------------------------------------------------- the controller

# Where a controller is wrong rather than a matter of taste or of the model's error.
OVERSHOOT, SETTLING = 20.0, 2.0  # percentage points above the goal; times the goal
CLAIM_OVERSHOOT, CLAIM_SETTLING = 12.0, 1.6
PREFILTER, PREFILTER_BLURRED = 0.10, 0.20
PREFILTER_SIGMAS = 2.0  # of the fitted static gains, which a prefilter may be off by
