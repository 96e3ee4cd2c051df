"""Turn the laws that `gap.pem` found into effects, fit them to whole runs, and judge them."""
