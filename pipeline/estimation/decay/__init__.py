"""Find and fit damped sinusoids and dry friction in free motion."""
