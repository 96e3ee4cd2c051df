"""Turn archives, folders and platforms' downloads into submissions."""
