"""Identify the carts from records, after leaving out records that do not hold what happened."""
