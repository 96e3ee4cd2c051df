"""Choosing experiments: what to record, with which controller, in which size."""
