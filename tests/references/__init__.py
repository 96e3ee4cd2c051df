"""What the program says of many inputs, as facts: kept from one version, compared with the next."""
