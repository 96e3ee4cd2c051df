"""Commands of the bench: plan, acquire, emulate."""
