"""The carts: linear chain, exact simulation, feedback loop."""
