"""Factors that appear when a log is in another unit or its clock is wrong, with their names."""

LENGTH_SCALES = (10.0, 100.0, 1000.0, 2.54, 25.4)  # between mm, cm, m and inches
# For each factor of a time column in another unit: the name of the unit, in full and in headings.
TIME_UNITS = {1e3: ("milliseconds", "ms"), 1e6: ("microseconds", "us")}
TIME_FACTORS = {
    **{factor: f"its time seems to be in {unit}" for factor, (unit, _) in TIME_UNITS.items()},
    1e-3: "its time looks to be in thousands of seconds, or in seconds under a heading that says "
    "ms (correct the heading)",
    2.0: "its clock seems to run at twice the right speed",
    0.5: "its clock seems to run at half the right speed",
}
FASTEST = 1e-4  # s between samples; no bench reads its encoders faster
