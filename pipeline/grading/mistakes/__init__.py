"""Which mistake makes this number: of the tables, the model, the controller, the recordings."""
