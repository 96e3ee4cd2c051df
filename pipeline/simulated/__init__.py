"""Simulated benches: one value that writes a submission, or answers as a bench on a line."""
