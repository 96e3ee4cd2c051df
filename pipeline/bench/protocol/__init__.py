"""What host and bench say to each other, and the clock behind it."""
