"""Consistency checks of the data, the estimates, the carts and the loops."""
