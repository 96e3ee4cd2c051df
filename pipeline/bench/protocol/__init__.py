"""The messages between host and bench, and the clock that their time stamps come from."""
