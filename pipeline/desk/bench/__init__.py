"""The bench's room: plan, acquire, watch."""
