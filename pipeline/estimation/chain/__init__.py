"""Fit a chain: its parameters, its response, and the residuals of records."""
