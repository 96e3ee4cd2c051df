"""The next experiment: how much one would tell, which tell most, and what to make of them."""
