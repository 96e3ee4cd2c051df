"""Find faults of recordings, and contradictions between recordings, and describe them."""
