"""What the search amounts to: the verdict, its account, and where the model still departs."""
