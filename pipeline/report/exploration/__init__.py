"""The diary of an exploration, as a page."""
