"""Choose experiments: what to record, with which controller and which amplitude."""
