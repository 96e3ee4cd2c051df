"""Turn the laws that `gap.follow` found into effects, fit them to whole runs, and judge them."""
