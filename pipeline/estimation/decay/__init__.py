"""Damped sinusoids and dry friction in free motion: found and fitted."""
