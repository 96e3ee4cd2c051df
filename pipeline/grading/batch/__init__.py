"""Grade a whole class: workers, isolation, cluster."""
