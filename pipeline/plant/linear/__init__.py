"""The chain of carts: its equations, the maps to and from named parameters, exact simulation."""
