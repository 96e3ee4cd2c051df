"""Turn archives, folders and downloads from learning platforms into submissions."""
