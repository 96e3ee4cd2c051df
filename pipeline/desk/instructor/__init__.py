"""The instructor's room: exercises, solutions, rubrics, the catalogue of effects."""
