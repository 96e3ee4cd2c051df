"""Fit models that follow the measurement: every law at every place at once, from zero."""
