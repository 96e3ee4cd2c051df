"""The limits that decide the verdict on a gap, each with its reason.

Constants that only save time, or set the start of a fit, are beside the code that uses them.
`benchmarks/gap_confusion.py --report` measures the success rates of these limits, listed in
`benchmarks/gap.md`.
"""

# Neighbouring residuals are not independent: of a motion of some 5 Hz, read at 100 to 250 Hz, about
# every tenth reading is independent.
THINNING = 10.0
# Chi-square per point that still counts as noise. For 1000 such readings it scatters by √(2/1000) =
# 0.045; this is three times that. Of 60 linear benches the largest was 1.07; of 300 none gave an
# alarm.
AT_FLOOR = 1.15
TOO_GOOD = 0.7  # … and a value six standard deviations below one
NOTHING = 1.05  # times the noise: the excess, √(1.05² - 1), is a third of the noise
# For runs with one input: an error below this multiple of their difference is theirs. Two or three
# repeats determine that difference to no better than a tenth.
AS_REPEATS = 1.1

# The Bayesian criterion must fall by 10 for very strong evidence (R. E. Kass, A. E. Raftery, J.
# American Statistical Association 90 (1995), 773-795), and by 2 ln 150 more, for the best of some
# 150 laws and places. For a law that another cart already has, their "strong" suffices.
BIC_DROP, SAME_LAW = 20.0, 6.0
# The largest error of a named model, in units of the noise or of the difference of repeats. It is
# wide for contacts, whose law is only approximate. Nine of ten names leave at most 1.02 times the
# noise. A named model without a contact whose error exceeds FURTHER is often half of the truth, and
# a note says so.
ENOUGH_NOISE, ENOUGH_REPEATS, FURTHER = 2.0, 1.5, 1.3
SURE = 3.0  # standard errors from zero: a nearer effect is not named
PARTIAL_GAIN = 0.9  # of the error, when too much is left for a name: a tenth is worth reporting
# The gain required behind a play, which a following model takes as rigid: another law would absorb
# the rest of the bounce.
CONTACT_GAIN = 0.5

# A rival is within 15 % of the error. Its criterion is nearer than a tenth of the gain, and nearer
# than twice the gain required of an effect.
CLOSE_ERROR, CLOSE_GAIN, CLOSE_BIC = 1.15, 0.10, 2.0 * BIC_DROP
MOSTLY = 0.5  # of the error: above this, most of it is unexplained
NEAR_FLOOR = 1.5  # times the noise: above this, more than half of the squared rest is not noise

# A constant force: in standard errors, as every cart is tested; as a share of the zeros' sum of
# squares; and in encoder steps, as a cart may be zeroed one step off.
OFFSET_SURE, OFFSET_SHARE, OFFSET_STEPS = 6.0, 0.8, 1.5
# Errors with the encoder zeros of the file: without the force, relative to the error without it;
# with the force, relative to the error with free zeros. A real force keeps the latter low.
OFFSET_GAIN, OFFSET_AS_FREE = 0.9, 1.1
