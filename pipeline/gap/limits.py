"""The limits that decide the verdict on a gap, each with its reason.

Constants that only save time, or that set the start of a fit, are next to the code that uses them.
`benchmarks/gap_confusion.py --report` measures the success rates with these limits, and
`benchmarks/gap.md` lists them.
"""

# Neighbouring residuals are not independent. For a motion of some 5 Hz, read at 100 to 250 Hz,
# about every tenth reading is independent.
THINNING = 10.0
# Chi-square per point that still counts as noise. For 1000 such readings its standard deviation is
# √(2/1000) = 0.045; the limit is three times that above 1. On 60 linear benches the largest value
# was 1.07; of 300, none gave a false alarm.
AT_FLOOR = 1.15
TOO_GOOD = 0.7  # chi-square this far below 1 (six standard deviations): the noise is overestimated
NOTHING = 1.05  # times the noise. The excess, √(1.05² - 1), is a third of the noise
# For runs with the same input: an error below this multiple of their difference is due to the runs
# themselves. Two or three repeats determine that difference only to a tenth.
AS_REPEATS = 1.1

# For a new effect, the Bayesian criterion must fall by 20. A fall by 10 is very strong evidence (R.
# E. Kass, A. E. Raftery, J. American Statistical Association 90 (1995), 773-795). 2 ln 150 = 10 is
# added for choosing the best of some 150 laws and places. For a law that another cart already has,
# 6 is enough ("strong").
BIC_DROP, SAME_LAW = 20.0, 6.0
# The largest error of a named model, in units of the noise or of the difference of repeats. It is
# generous because the law of a contact is only approximate. Nine of ten named models leave at most
# 1.02 times the noise. If a named model without a contact has an error above FURTHER, often half of
# the truth is missing, and a note says so.
ENOUGH_NOISE, ENOUGH_REPEATS, FURTHER = 2.0, 1.5, 1.3
SURE = 3.0  # standard errors. An effect nearer to zero is not named
# Share of the error that may remain after an effect, if the gap cannot be named.
PARTIAL_GAIN = 0.9
# For a law beside a play: it must remove this share of the excess. The contact of a model that
# follows the record is rigid, and another law would absorb the error of the bounce.
CONTACT_GAIN = 0.5

# A rival has an error within 15 %. Its criterion is closer than a tenth of the gain, and closer
# than twice the gain that an effect needs.
CLOSE_ERROR, CLOSE_GAIN, CLOSE_BIC = 1.15, 0.10, 2.0 * BIC_DROP
MOSTLY = 0.5  # above this share of the baseline's error, most is unexplained
NEAR_FLOOR = 1.5  # times the noise. Above this, most of the squared error is not noise

# A constant force must reach all three limits: in standard errors, as every cart is tested; as a
# share of the zeros' sum of squares; and in encoder steps, as a cart may be zeroed one step off.
OFFSET_SURE, OFFSET_SHARE, OFFSET_STEPS = 6.0, 0.8, 1.5
# Largest error with the constant force and the encoder zeros of the file: relative to the error
# without the force, and relative to the error with free zeros. Only a real force meets both limits.
OFFSET_GAIN, OFFSET_AS_FREE = 0.9, 1.1
