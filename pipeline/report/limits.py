"""The limits that decide what a report says, each with its reason.

What only sets how a thing is drawn, or how much of it is told, stands beside the code that uses it.
The limits of "agree" are those of the stage that compares (`stages/compare.py`).
"""

# ---- numbers
CALIBRATION = 1e-3  # no teaching bench's encoder and motor are known better than this share
COARSE = 1e-2  # an error from here on: two digits of it leave four of the value
UNSURE_DIGITS = 3  # of a number whose error says too little, as the model misses something
NEGLIGIBLE = 1e-3  # of a value: an error this small stands in the table alone
CHANCE = 1.0  # standard errors; a number that moved by less did not move
NO_CHANGE = 0.05  # percent between the fit cart by cart and the joint one: nothing to speak of
# Of the limit for initial and final: other ways through the same data differ so much, so a
# student's number within it is not asked about.
FEW = 1 / 3

# ---- bench against model
CLOSE = 0.10  # of the motion, rms: within it a good linear model; beyond, worth a question
LEVEL, OVERSHOOT = 0.03, 5.0  # of the level; percent of the step: differences worth a question
INPUT_AS_LOGGED = 0.05  # a factor on the input this near one is not worth a word

# ---- the gap
AS_GOOD = 1.15  # times the error: a rival that the data do not tell from what was chosen
# A factor on the logged input is believed where 0.6 of the error goes with it; within 1.5 it is no
# other scale, but the model's error.
WORTH_SCALING, OTHER_SCALE = 0.6, 1.5
