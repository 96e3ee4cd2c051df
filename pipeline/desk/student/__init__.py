"""The student's room: from dropped files to the zip that is handed in."""
