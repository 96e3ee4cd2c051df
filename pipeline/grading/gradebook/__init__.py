"""The gradebook: gradings, changes, and who made them."""
