"""The limits that decide what a record says of a chain, each with its reason."""

import numpy as np

# The share of a record's power (about its mean) that a chain may leave: carts with dry friction
# leave some 2 %, a wrong chain most.
FOLLOWED = 0.1
# Read otherwise it follows ten times better than as recorded, which leaves half a percent or more:
# what stays of a good record is friction, and no other reading takes that away.
DOUBTFUL, BETTER = 0.005, 10.0
TURNED = 0.02  # what a record that counts the other way leaves at most; a long delay leaves more
SAME_SCALE = 0.1  # relative, of a unit's factor: the known ones lie 2.5 times apart
UNMISTAKABLE = 10.0  # an amplifier at its limit makes less of the input by a factor of 2 or 3
DELAY_COUNTS = 20.0  # encoder steps of motion from which on a channel's delay shows
SEEN_STEPS = 5.0  # encoder steps of motion: rounding changes a smaller one by any factor
# A spring that stiffens, or an input that is late, shifts resonances by some percent.
DETUNED = np.linspace(0.85, 1.15, 13)
# Simulated carts with dry friction F under a force of amplitude A leave at least (F / 5A)² where
# they move at all, which is doubled here; encoder and noise hide shares below the least.
FRICTION_PER_ROOT, LEAST_SHARE = 10.0, 1e-4

FRICTION_F = 10.8  # F(1, many) above this once in a thousand decays without friction
# Residual over noise up to which a model says all there is to say: with 50 samples chance moves it
# by a tenth.
ADEQUATE = 1.5
