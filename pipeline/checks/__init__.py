"""Consistency checks: what the data, the estimates, the carts and the loops must obey."""
