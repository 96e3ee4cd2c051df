"""A class at once: workers, isolation, cluster."""
