"""What to record, with which controller, and what it asks of the bench."""
