"""The TA's room: a class, a team's points beside the evidence, what several change at once."""
