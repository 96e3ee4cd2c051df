"""The chain under sampled feedback: gains, simulation, margins, robustness."""
