"""The JSON files as other programs read them: models to validate with and to make a schema from."""
