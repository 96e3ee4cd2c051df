"""The page with interactive plots of every recording and its models."""
