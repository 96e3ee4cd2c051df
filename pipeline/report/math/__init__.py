"""Mathematics as a small tree, which every page can set."""
