"""Export an analysis for other programs: tables for pandas, variables for MATLAB, models."""
