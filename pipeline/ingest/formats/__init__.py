"""The formats of data files, each read to a table of named columns."""
