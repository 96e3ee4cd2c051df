"""cartlab: identification, control and grading for the mass-spring-damper laboratory."""

__version__ = "0.1.0"
