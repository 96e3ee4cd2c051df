"""What following finds, as effects of the catalogue, fitted to whole runs and judged."""
