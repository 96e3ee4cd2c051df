"""Limits for verdicts on a plant, a loop or an effect, each with its reason."""

HEAVY_DAMPING = 0.3  # damping ratio; above it the usual orders of frequencies may fail
CALIBRATION = 1e-3  # relative; no encoder or motor of a teaching bench is known better
SETTLING_BAND = 0.02  # of the change in level, the 2 % criterion

# Relative errors that a design must tolerate: of an identified mass or spring, and of a damping.
# The damping of a real cart differs by a quarter between driven and free motion, its spring by some
# percent.
MASS_SPRING_ERROR, DAMPING_ERROR = 0.03, 0.30

# Sample times. A delay and a lag of size T have the same mean delay. They first differ in the
# second moment, by T²/2, which is here an eighth of a sample squared.
MUCH_SHORTER = 0.5
LEAST_SLIDING = 0.01  # of the force at rest; no dry surface slides with less
