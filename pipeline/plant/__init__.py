"""Models of the carts: linear, under feedback, and with effects that the linear model lacks."""
