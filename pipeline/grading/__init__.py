"""Grading one submission: rubric, checks against the student's own data, named mistakes."""
