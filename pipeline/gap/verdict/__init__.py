"""The result of a search: the verdict, its account, and where the model still departs."""
