"""From records to estimates: each stage is one file, and so is each method that several use."""
