"""The compiled simulator, with derivatives integrated beside the state."""
