"""The desk: one local web page for student, TA, instructor and bench."""
