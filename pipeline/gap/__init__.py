"""Find the physical effects that the linear model lacks, and test them on held-out runs."""
