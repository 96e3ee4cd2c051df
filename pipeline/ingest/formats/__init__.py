"""The forms a data file may have, each read to a table of named columns."""
