"""The page with interactive plots of every recording and its models."""

NAME = "compare.html"  # next to report.html
