"""The diary of an exploration, as a page."""

NAME = "exploration.html"  # in the folder of the submission
