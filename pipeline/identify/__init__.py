"""Identify the carts from the records that show what happened; check records and results."""
