"""Archives, folders and platforms' downloads to submissions."""
