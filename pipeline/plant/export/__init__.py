"""The model for other programs: python-control, C, MATLAB and FMU."""
