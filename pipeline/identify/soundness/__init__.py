"""Which recordings do not hold what happened, and what they did instead."""
