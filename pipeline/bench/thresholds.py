"""The numbers that decide what is said of a bench and its runs, each with its reason.

What paces a loop or bounds a read stands beside the code that uses it.
"""

# ---- lines: a line is judged when its neighbours are there
SPIKE = 32  # counts a true reading may stand out between its neighbours: a hit on an end stop
LATE = 0.02  # s behind the earliest lines: they waited somewhere for one another
LEAP = 1000  # ms between two stamps: no line for so long, or a clock that jumped
# Lines whose stamps are looked at together, and the least share of their time the clock may go on
# meanwhile: half of it would be another period, less is a clock that stands still.
CROWD, CROWDED = 500, 0.25
# An encoder that stands still in a window (ms) though it moved in the one before and the motor
# drives on as much (duty counts; less moves no cart) is stuck; so is one that never moved, of the
# driven cart, or beside a neighbour that did.
WINDOW, MOVED, NEIGHBOUR_MOVED, DRIVEN = 1000, 20, 200, 8

# ---- runs
SILENCE = 0.5  # s without a byte in mid-run: the bench is gone
UNREADABLE = 0.25  # s of bytes that are no lines: the motor may be on, and nobody sees the carts
NEARLY = 100.0  # ms before the end at which silence is the end; after it lines are too many
STILL = 4  # counts a cart at rest may flicker; a run in which no free cart moves more is none
REST_WINDOW = 500.0  # ms at the end of a rest over which it is judged
ASTRAY = 4  # ms of lines in a row of another target or duty: five at 1 kHz, else two at least
ENOUGH = 1000  # lines that tell a clock's period
TRIES = 3  # of one recording; a fault that strikes three times is not chance

# ---- the clock's stamps, in ms
STRIP = 1.25  # stamps of one even clock lie within 1 ms of a line; a loss makes it 1.5 or more
SLOW = 1.5  # from this period on each difference tells by itself
CLOSEST_TEETH = 20  # a clock of 1.05 ms; one further off is no bench's that aims at 1 kHz
MOST_ABSENT = 0.2  # of the stamps; more is a slower clock
BY_CHANCE = 0.01  # how likely losses may look like a comb
TOOTH_SLACK = 1  # a tooth may be off: stamps are rounded
OTHER_PERIOD = 0.02  # of a period: no clock is so far off the one that is stated
# Pieces of so many lines, of which some lack none unless one in a hundred is lost: the share that
# must be even, and how alike their periods, as rounding has it.
PIECE, FEWEST_EVEN, ALIKE = 200, 0.25, 0.01

# ---- plans and controllers
ROUNDED = 1.01  # an input limit typed with fewer digits may pass full scale by so much
SAME_SCALE = 1e-3  # scales that differ by less are the same number typed with fewer digits
SAME_FREQUENCY = 0.05  # of it: a dwell recorded for the one the plan asks for
UNSEEN_COUNTS = 2.0  # of overshoot: no encoder tells them from its own flicker
