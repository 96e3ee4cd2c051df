"""Limits for verdicts on a plant, a loop or an effect, each with its reason."""

HEAVY_DAMPING = 0.3  # damping ratio; above it, resonances and nulls may lose their usual order
CALIBRATION = 1e-3  # relative error; encoders and motor of a bench are not known more accurately
SETTLING_BAND = 0.02  # share of the change in level: the 2 % criterion

# Relative errors that a design must tolerate: one for identified masses and springs, one for
# dampings. Between driven and free motion, a real cart's damping differs by a quarter and its
# spring by some percent.
MASS_SPRING_ERROR, DAMPING_ERROR = 0.03, 0.30

# In sample times. A delay and a lag of the same size T delay the input equally on average. They
# first differ in the second moment, by T²/2. At this limit that is an eighth of a squared sample
# time.
MUCH_SHORTER = 0.5
LEAST_SLIDING = 0.01  # share of the friction at rest; any dry surface has more while it slides
