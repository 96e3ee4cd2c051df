"""The carts: linear, under feedback, and with what the linear model leaves out."""
