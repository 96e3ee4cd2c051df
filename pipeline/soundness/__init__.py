"""What is wrong with a recording, or contradicts another: found here, and said in one place."""
