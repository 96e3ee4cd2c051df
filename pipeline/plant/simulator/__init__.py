"""The compiled simulator; derivatives are integrated with the state."""
