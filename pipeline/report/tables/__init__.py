"""The tables of a report, as data: numbers formatted, parameter names as mathematics."""
