"""A zip that makes Gradescope grade each submission when it is uploaded."""
