"""The TA's room: a class, each team's points with the evidence, and changes to several teams."""
