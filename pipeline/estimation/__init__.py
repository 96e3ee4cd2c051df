"""Methods that several stages use: noise, peaks, levels, transforms and least squares."""
