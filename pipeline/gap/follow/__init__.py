"""Fit models while they follow the measurement: every law at every place at once, from nothing."""
