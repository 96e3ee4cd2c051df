"""Make Gradescope grade each submission with cartlab when a student uploads it."""
