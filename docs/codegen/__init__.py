"""Writes what is made from the effects' laws: `python -m docs.codegen`."""
