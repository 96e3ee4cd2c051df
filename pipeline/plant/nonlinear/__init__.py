"""The chain with effects: catalogue, tables, simulation."""
