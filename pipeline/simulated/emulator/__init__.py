"""The virtual bench: carts and a controller behind a serial line."""
