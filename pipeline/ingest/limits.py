"""The limits that decide what is said of a data file, each with its reason.

What only bounds the work, or names a form, stands beside the code that uses it.
"""

# ---- encoders
MOST_LEVELS = 20_000  # an encoder on a lab cart has a few thousand counts over its travel
ON_GRID = 0.15  # of a step, rms: farther off, the values are not multiples of one step
MIRRORED = 0.8  # of the samples in motion: a commanded position that only repeats encoder 1
# Encoder steps a sample: no cart stops from that speed between two samples. And times the fastest
# other move between two samples: no cart starts so from rest.
ABRUPT, JUMP = 5.0, 1.5
STUCK_SAMPLES = 10  # at rest that long at a turning point a cart moves less than one step
HELD_STEPS = 2.0  # encoder steps over a whole record; a cart that is free moves more
HARDLY = 0.05  # of the furthest cart's motion; less may be a cart that a hand held

# ---- the input
# A clipped input takes its extreme so many times as often as the next level; the rounded crest of
# a sine 1.4 times. A stepped input, of few levels, is at its extremes by design.
CLIPPED_SAMPLES, CLIPPED_SHARE, FEW_LEVELS = 3, 5, 20
FEW_COUNTS = 10  # a motor does not move at so few; whole numbers up to it are volts, typed in
# Of the input's range: an edge, and between edges its rms; a sweep has more edges than 20.
EDGE, FLAT, MOST_EDGES = 0.2, 0.03, 20
ONE_LINE = 0.9  # share of the input's power in one spectral line: a dwell
# The sign. Of the input's power: how much more the other sign must leave unexplained to be ruled
# out. Far above what an encoder's steps do; a cart's damping is worth more at every frequency that
# moves it.
SIGN_LEAST, SIGN_SHARE = 1e-3, 0.1
# Of the cosine between an input and the force that the bench's equation gives. A lag (at most 90°)
# and any likely delay stay above zero; a log that counts the other way is near -1.
SIGN_TELLS, SIGN_CONTRARY = 0.3, -0.7

# ---- the clock
SLOW, QUICK = 0.5, 1e-5  # s between samples; no bench records slower or faster than these
GAP = 4.0  # usual intervals without a sample: time is missing
UNEVEN = 0.01  # of the interval, rms: a clock worth a word
RATE_DIFFERS = 0.01  # of a stated rate that the time column contradicts
WORTH_STRAIGHTENING = 2e-3  # of the interval: finer rounding of the stamps does no harm
ROUNDING_BAND = 0.65  # of the rounding step: half of it, and what the fit of a short piece errs
ROUNDING_REACH, IN_BAND = 1.5, 0.99  # a rare stamp may be a step off: a late tick, a beat
WHOLE_STEP = 0.9  # of the rounding step off the line: more is a stamp that did not advance
SHORTEST_PIECE = 32  # samples; a fit of fewer leaves the band by chance
MOSTLY = 0.8  # share of samples on straight pieces below which the clock itself is uneven

# ---- records and tables
FEWEST_SAMPLES = 8  # any estimate needs some
WINDOW_SLACK = 0.01  # of the record's length: "to the end" is often typed rounded up
# Relative standard error of a ratio read off two plots, where fewer than three degrees of freedom
# of repeats show the true spread.
RATIO_SPREAD, ENOUGH_REPEATS = 0.01, 3
