"""Export the chain with its effects as a model for other programs: C, FMU, MATLAB and Octave."""
