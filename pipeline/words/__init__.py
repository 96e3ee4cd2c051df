"""Write numbers, lists, names and sentences in the same way everywhere."""
