"""How numbers, lists, names and sentences are written: the same words in every room."""
