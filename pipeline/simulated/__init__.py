"""Simulated benches, which write submissions or answer on a serial line."""
