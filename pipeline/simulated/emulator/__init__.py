"""The virtual bench: carts and a controller at the end of a serial line."""
