"""The residual of the linear model, and the physical effect that explains it on held-out runs."""
