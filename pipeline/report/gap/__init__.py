"""The gap analysis as a separate report and as a section of the main report."""
