"""The laws found by following, as effects of the catalogue, fitted to whole runs and judged."""
