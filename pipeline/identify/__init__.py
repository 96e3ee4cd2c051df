"""Identify the carts from records, after leaving out records that do not show what happened."""
