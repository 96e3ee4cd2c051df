"""The limits behind each verdict on a plant, a loop or an effect, each with its reason."""

HEAVY_DAMPING = 0.3  # of a damping ratio: above it the orders of frequencies may fail
CALIBRATION = 1e-3  # no teaching bench's encoder and motor are known better than this share
SETTLING_BAND = 0.02  # of the change in level: the 2 % criterion

# Relative errors of an identified mass or spring, and of a damping, that a design must tolerate: a
# real cart's damping differs by a quarter between driven and free, its spring by some percent.
MASS_SPRING_ERROR, DAMPING_ERROR = 0.03, 0.30

# Sample times: a delay and a lag of one size T have the same mean delay, and first differ by T²/2
# in the second moment, an eighth of a sample squared.
MUCH_SHORTER = 0.5
LEAST_SLIDING = 0.01  # of the force at rest: no dry surface slides with less
