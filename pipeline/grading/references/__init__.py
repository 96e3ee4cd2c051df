"""Reference values from the recordings, and their tolerances."""
