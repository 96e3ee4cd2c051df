"""What the linear model leaves out: a report of its own, and a section of the other."""
