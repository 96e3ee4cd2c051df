"""The limits that decide what is said of a gap, each with its reason.

What only saves time, or where a fit begins, stands beside the code that uses it. The rates that
these limits give are those of `benchmarks/gap_confusion.py --report`, listed in `docs/gap.md`.
"""

# Neighbouring residuals are not independent: of a motion of some 5 Hz, read at 100 to 250 Hz, about
# every tenth reading is news.
THINNING = 10.0
# Chi-square per point that is still noise. Of 1000 such readings it scatters by √(2/1000) = 0.045:
# three of that. Of 60 linear benches the largest was 1.07; of 300 none gave an alarm.
AT_FLOOR = 1.15
TOO_GOOD = 0.7  # … and that no fit to noise of the right size falls to, six of that below one
NOTHING = 1.05  # times the noise: what goes beyond it, √(1.05² - 1), is a third of it
# Of runs with one input: an error below this many times what they differ by is theirs, known from
# two or three repeats to no better than a tenth.
AS_REPEATS = 1.1

# The Bayesian criterion must fall by 10 for very strong evidence (R. E. Kass, A. E. Raftery,
# J. American Statistical Association 90 (1995), 773-795), and by 2 ln 150 more, as if the best of
# some 150 laws and places were taken; by their "strong" for a law that another cart already has.
BIC_DROP, SAME_LAW = 20.0, 6.0
# Times the noise, or what repeats differ by, that a name may leave. Wide for the sake of contacts,
# whose own law is not the model's; nine of ten names leave at most 1.02 times the noise, and who
# leaves more than FURTHER without a contact is often half of what acts, which is said.
ENOUGH_NOISE, ENOUGH_REPEATS, FURTHER = 2.0, 1.5, 1.3
SURE = 3.0  # standard errors from nothing: whoever is nearer is not named
PARTIAL_GAIN = 0.9  # of the error, where too much for a name is left: a tenth is worth telling
# What must be gained behind a play, which a model that follows takes as rigid: another law would
# mop up the rest of the bounce.
CONTACT_GAIN = 0.5

# A rival: within 15 % of the error, and in the criterion nearer than a tenth of what is gained, and
# than twice what an effect must gain.
CLOSE_ERROR, CLOSE_GAIN, CLOSE_BIC = 1.15, 0.10, 2.0 * BIC_DROP
MOSTLY = 0.5  # of the error: who leaves more has not explained most of it
NEAR_FLOOR = 1.5  # times the noise: beyond, more than half of what remains, in squares, swings

# A constant force: in standard errors, for it is looked for on every cart; as a share of the zeros'
# sum of squares; and in encoder steps, for a cart may be zeroed one step off.
OFFSET_SURE, OFFSET_SHARE, OFFSET_STEPS = 6.0, 0.8, 1.5
# Of the error without it, the encoders' zeros being those of the file; and with it, of the error
# with free zeros, which a force that is there leaves as low.
OFFSET_GAIN, OFFSET_AS_FREE = 0.9, 1.1
