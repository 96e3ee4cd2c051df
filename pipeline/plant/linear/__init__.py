"""The chain of carts: equations, maps to and from named parameters, exact simulation."""
