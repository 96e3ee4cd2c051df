"""The limits that decide the verdict on a gap, each with its reason.

Constants that only save time, or that set the start of a fit, are next to the code that uses them.
`benchmarks/gap_confusion.py --report` measures the success rates with these limits, and
`benchmarks/gap.md` lists them.
"""

# Neighbouring residuals are not independent. For a motion of some 5 Hz, read at 100 to 250 Hz,
# about every tenth reading is independent.
THINNING = 10.0
# Chi-square per point that still counts as noise. For 1000 independent readings its standard
# deviation is √(2/1000) = 0.045; the limit exceeds 1 by three times that. The largest value on 60
# linear benches was 1.07. None of 300 linear benches gave a false alarm.
AT_FLOOR = 1.15
TOO_GOOD = 0.7  # chi-square; below it (six standard deviations), the noise is overestimated
NOTHING = 1.05  # times the noise; the excess, √(1.05² - 1), is then a third of the noise
# For runs with the same input: an error below this multiple of their difference is due to the runs
# themselves. With two or three repeats, the difference is only known to a tenth.
AS_REPEATS = 1.1

# For a new effect, the Bayesian criterion must fall by 20. A fall by 10 is very strong evidence (R.
# E. Kass, A. E. Raftery, J. American Statistical Association 90 (1995), 773-795). Another 2 ln 150
# = 10 is needed because the best of some 150 laws and places is chosen. For a law that another cart
# already has, 6 is enough ("strong").
BIC_DROP, SAME_LAW = 20.0, 6.0
# The largest error of a named model, in units of the noise or of the difference of repeats. It is
# generous because the law of a contact is only approximate. Nine of ten named models leave at most
# 1.02 times the noise. If a named model without a contact has an error above FURTHER, half of the
# true effects are often missing, and a note says so.
ENOUGH_NOISE, ENOUGH_REPEATS, FURTHER = 2.0, 1.5, 1.3
SURE = 3.0  # standard errors; an effect closer to zero is not named unless it halves the error
# Share of the error that may remain after a new effect, if the gap cannot be named.
PARTIAL_GAIN = 0.9
# Share of the excess that a law must remove if there is backlash. The contact of a model that
# follows the record is rigid, so another law would absorb the error of the bounce.
CONTACT_GAIN = 0.5

# A rival's error is at most 15 % larger. Its criterion is closer than a tenth of the chosen model's
# gain, and closer than twice the fall that a new effect needs.
CLOSE_ERROR, CLOSE_GAIN, CLOSE_BIC = 1.15, 0.10, 2.0 * BIC_DROP
MOSTLY = 0.5  # share of the linear model's error; above it, most of the gap is unexplained
NO_MODEL = 0.4  # share of the motion; above it, the model does not fit the recordings at all
NEAR_FLOOR = 1.5  # times the noise; above it, most of the squared error is not noise

# A constant force must reach three limits. It must exceed this many standard errors, because every
# cart is tested. It must explain this share of the zeros' sum of squares. And the zeros must exceed
# this many encoder steps, because a cart may be zeroed one step off.
OFFSET_SURE, OFFSET_SHARE, OFFSET_STEPS = 6.0, 0.8, 1.5
# Largest error with the constant force and the encoder zeros of the file: relative to the error
# without the force, and relative to the error with free zeros. Only a real force meets both limits.
OFFSET_GAIN, OFFSET_AS_FREE = 0.9, 1.1
