"""Fitting one chain: its parameters, how it answers, and what records leave of it."""
