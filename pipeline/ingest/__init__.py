"""From every known file form to `Record`, with units, signs and clocks settled."""
