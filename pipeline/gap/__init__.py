"""What the linear model leaves, and the physical effect that explains it on held-out runs."""
