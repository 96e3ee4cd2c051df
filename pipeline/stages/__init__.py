"""One file for each stage; stages never import each other."""
