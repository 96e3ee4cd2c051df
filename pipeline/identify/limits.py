"""The limits that decide whether a recording is used, each with its reason.

`tests/statistics/test_honest_records.py` shows that they accuse no honest record, of sticking
carts and coarse encoders too; `tests/grading/mistakes/test_faults.py` that they find wrong ones.
"""

# Who may bear witness: one record, or one kind of record, is right or wrong by chance.
WITNESSES = 2
SIGMAS = 4.0  # standard errors: by chance one number in 16,000 is as far off
SAME = 0.02  # relative: of an encoder step, a clock or a length that a program sets for all

# A reading that stays while the input changes over half its range, and for a fifth of the record
# after it; meanwhile the carts, as identified, must move by so many encoder steps and by such a
# share of their motion, as a delay or play may hold one for a moment.
STILL_INPUT, STILL_SHARE = 0.5, 0.2
SEEN_COUNTS, SEEN_SHARE = 5.0, 0.3
# Frozen in between: for ten samples, while the carts move by a fifth of the motion; elsewhere the
# record misses them by a quarter of that at most, so that it does follow them.
FROZEN_SAMPLES, FROZEN_SHARE, FROZEN_ELSEWHERE = 10, 0.2, 0.25
# Stuck at speed: static friction stops a crawl, which is far slower than the fastest 2 % of the
# moves from sample to sample; or the encoder jumps, by more than any such move, when it goes on.
FASTEST_MOVES, STUCK_SPEED, STUCK_JUMP = 0.98, 0.6, 1.5

# A record that follows no carts like the others': more than half of every cart's power unexplained,
# and no smaller motion than theirs, for friction makes no cart move further.
STRAY, STRAY_REACH = 0.5, 0.8
# A kind of records that contradicts a fit to others: inches instead of centimetres leave 0.37.
CONTRARY = 0.3
FARTHER = 1.3  # times the static gain of the cart that pulls: friction may hold carts off a little
FEWEST_CYCLES = 1.5  # of a dwell: with fewer there is no steady state, whatever the damping
CLOCK_UNIT = 100.0  # times as slow is another unit of time; twice may be another setting
CUT_LENGTH = 0.5  # of what all repeats last, where a program ends them not
DRIVEN_DECAY = 1e-3  # of the largest input of any run: a decay with more is driven

# m/s: the carts of a bench reach 0.4, those of inverted pendulums 3; centimetres read as metres
# make 15 to 40. Over so many s, by the fastest hundredth left out: an encoder's jump is no speed.
FASTEST, SPEED_OVER, SPEED_SHARE = 10.0, 0.02, 0.99

# Two runs for one number: the same run made twice differs by some percent with dry friction, and
# its damping, with a bearing's dirt, by half. Beyond that, and beyond `SIGMAS`, one is wrong.
TOLERANCE, DAMPING_TOLERANCE = 10.0, 50.0  # percent
LIKE_THE_FIT = 0.15  # relative: as far as initial and final estimates may lie apart (Throne 2005)
# Factors by which friction, play or a soft hold may move a gain or a frequency.
BY_THE_BENCH = {"K": 1.6, "omega": 1.3}
SAME_MISTAKE = 0.05  # relative: what a known mistake leaves of the difference between two runs
SAME_SIZE = 0.2  # relative: two steps that friction treats alike

# Inputs count as the same where they differ by less than this share (root-mean-square): an edge
# logged one sample early differs by 8 %, the next usual amplitude by 33 %.
SAME_INPUT = 0.2
SAME_DURATION = 0.8  # shorter over longer
MATERIAL = 0.05  # of the response; a smaller difference changes nothing anybody would act on
# How many spreads of the others a repeat must stand off. Where all repeats differ by chance
# (along one shape, normally distributed) this flags 5 % of the sets, and far fewer where they
# differ in several ways; three repeats leave one difference to judge by, hence the caution.
SPREADS, SPREADS_OF_MANY = {3: 30.0, 4: 8.0}, 5.0

# Springs from steps. The weakest spring of a bench, over the one before it: a tenth and more. And
# inputs that are one level, as a share of their range; a cart that ends farther from where it began
# than this share of its motion is held by no spring, for friction holds it off by far less.
WEAKEST, SAME_LEVEL, AWAY = 0.1, 0.02, 0.5
