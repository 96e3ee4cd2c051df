"""Find the mistakes behind wrong numbers in tables, model, controller and recordings."""
