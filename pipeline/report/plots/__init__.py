"""The page of plots to look through: every record with its models, laid over each other."""
