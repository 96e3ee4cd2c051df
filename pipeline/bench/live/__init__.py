"""Views of a session: the terminal, a page in the browser."""
