"""Describe the result of a search: the verdict, the errors, and where the model fits badly."""
