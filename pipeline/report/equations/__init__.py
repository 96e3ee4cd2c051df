"""The equations of the carts: shown, worked out with numbers, derived."""
