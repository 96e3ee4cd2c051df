"""From every known file form to `Record`: units, signs and clocks are settled here."""
