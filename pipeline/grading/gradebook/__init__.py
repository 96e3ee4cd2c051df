"""The gradebook: a database of all gradings and of all points given by hand."""
