"""The decision limits of the checks, each with its reason."""

# ------------------------------------------------------------------------------- recordings

LONGEST = 3.0  # m from end to end: no bench has so long a track
LONGEST_WHOLE = 0.5  # … for one that is read to whole numbers alone, as counts are
LARGEST = 100.0  # V: no amplifier at a bench gives as much
HELD_FIRMLY = 0.05  # of the free carts' swing: what a firm hold yields at most
HELD_SHARE = 0.2  # of a held cart's swing: a free one that moves less is not the free one
OTHER_DWELL = 0.1  # relative: a dwell stated so far off is another one
LATE, LATE_SURE = 2.0, 4.0  # samples, and standard errors, that a channel is late by at least
# With its delay the carts' own law must leave so many times less. Friction, stops and stiff springs
# on benches all over what a lab may have look like delays that leave 1.7 times less at most; 44 ms
# leave 8 times on a bench with much friction, and thousands on one without.
LATE_BETTER = 5.0

# ------------------------------------------------------------------------- carts and loops

REDUNDANCY = 1e-9  # two routes to one number through unrounded values
BELOW_ZERO = 2.0  # standard errors that a mass, damping or spring may be below it
# Share of its larger neighbour: no bench's masses, dampers or springs differ fifty times. Where
# there is no spring, dry friction and loose screws feign one of up to 1 % of the next.
NEGLIGIBLE = 0.02
# Of the coefficients of a loop's polynomial, which are of the size of their binomials. Rounding
# leaves 1e-13 of them on plants that a bench can be; the other programs' gains up to 1e-8.
SAME_LOOP = 1e-6
