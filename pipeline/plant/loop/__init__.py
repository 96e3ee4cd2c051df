"""The chain under sampled feedback: gains, the loop simulated, margins, robustness."""
