"""The chain with its effects as a model for other programs: C, an FMU, MATLAB and Octave."""
