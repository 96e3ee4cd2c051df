"""The values of parameters that the recordings give, with bounds and tolerances."""
