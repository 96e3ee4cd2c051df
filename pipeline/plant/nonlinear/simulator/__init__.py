"""The compiled simulator, and derivatives carried beside the state."""
