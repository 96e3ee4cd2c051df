"""Pages served to a browser on this computer: who may ask, and who may stay connected."""
