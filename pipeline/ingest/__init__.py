"""Read every known file format into a `Record`, with units, signs and clocks settled."""
