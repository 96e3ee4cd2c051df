"""What the stages share: noise, peaks, level and transform estimators, least squares."""
