"""From records to carts: which records hold what happened, and the carts identified from them."""
