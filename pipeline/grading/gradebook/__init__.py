"""What was graded, changed, and by whom."""
