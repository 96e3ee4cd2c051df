"""Fit models that follow the measurement: every law at every place at once, from zero.

At each sample, a share of the error (the gain) corrects the model. So it never departs far from the
data.
"""
