"""An analysis as people go on with it elsewhere: tables for pandas, variables for MATLAB."""
