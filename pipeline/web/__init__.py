"""Serve pages to a browser on this computer: admit requests and limit connections."""
