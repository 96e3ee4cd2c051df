"""What the recordings say a number is, and how far off one may be."""
