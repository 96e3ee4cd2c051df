"""Find the mistakes that explain wrong numbers in tables, models, controllers and recordings."""
