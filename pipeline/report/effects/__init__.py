"""The catalogue of effects, as text and as a page with pictures."""
