"""The limits by which the stages decide, each with its reason."""

# Decays. A fit that leaves more of the motion is of something else: of real carts, which
# dry friction brakes, it leaves 1.3 to 2.1 % (ten runs).
NO_DECAY = 0.08
GROWS = 1.05  # damping at large amplitudes over the mean, where it is worth a word

# Steps. With less of the record at constant input this is no step run.
STEADY_SHARE = 0.6
MOVED = 6.0  # grains (encoder steps, or noise as coarse): a cart that moved less has not moved
EXTRAPOLATES = 0.02  # of the motion: what a fit that foretells the level may leave, and be off by
STICKS_SIGMAS = 4.0  # standard errors: by chance one edge in 16,000 is as far off
DRIFT_SIGMAS, DRIFT_AGREES = 5.0, 0.3  # a drift is seen, and alike in every settled window

# Dwells. The last windows agree to half a percent of the amplitude, or to their noise.
STEADY_SPREAD = 0.005
OFF_SINE = 0.01  # of the amplitude: a residual below this is a good sine
NO_SINE = 0.5  # of the input's amplitude: a residual above this is another signal
# A stated frequency as far off by standard errors, and by more than any clock, is not believed.
FREQUENCY_SIGMAS, FREQUENCY_RELATIVE = 5.0, 2e-4
FEW_COUNTS = 20  # encoder steps: an amplitude below is known to a few percent only

# Frequency response. A record's frequency is kept where the response stands five sigma out.
LARGEST_RELATIVE_STD = 0.2
UNSETTLED_STD = 0.05  # a dwell that ends before its steady state is off by a few per cent
LEAST_PROMINENCE = 0.05  # of ln|G|; and six standard errors: noise alone spans five in 40 points
CLEAR = 0.1  # relative error above which a point shows no peak

# Fits. Phases count unless so many times as far off as the magnitudes: a delay or a wrong sign is.
PHASE_AGREES = 3.0
DECAY_AGREES = 9.0  # χ² that each decay may add: by chance three standard errors off
EXCESS_SIGMAS = 3.1  # standard deviations of χ² above its mean: by chance once in a thousand
VANISHING = 1e-4  # of its usual size: a damping or far spring that the data put at zero
NEGLIGIBLE = 0.05  # of its standard error: a damping or wall spring that is held at zero
REST_SIGMAS = 5.0  # beyond chance, by which a free start must improve the fit to be kept

# Comparing. The paper's own tables: gains and frequencies change by up to 14 % between the two
# estimates (one null, read off by eye, by 29 %), damping ratios by half and more.
GAIN_AND_FREQUENCY_LIMIT, DAMPING_LIMIT = 15.0, 50.0  # percent
SIGMA_LIMIT = 3.0  # combined standard errors: below, a difference may be chance

# Feedback: percent of the step that errors in the springs may move the level, if it can be had;
# and from where on it is worth a word.
LEVEL_ERROR, LEVEL_WARNING = 10.0, 5.0

# Hardware. A factor on the input within this is the model's error, not the log's; another sign or
# scale is believed where it leaves at most this of the difference, and explains half the power.
TRUSTED, WORTH_IT, HALF_EXPLAINED = 1.5, 0.6, 0.7
# A plant right to the first under its very input, but off by the second, and so many times further,
# in the loop: it is not the loop that ran. A stable loop makes a plant's error some times larger.
RIGHT, WRONG, TIMES_WORSE = 0.02, 0.1, 5.0
AT, AWAY = 0.05, 0.2  # of the reference: a cart that settles there, and one that does not
SMALL_CHANGE = 0.05  # of the cart's largest motion; a smaller step has no overshoot to speak of
