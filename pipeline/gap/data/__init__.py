"""Prepare records for fitting: which are used, which are held out, where a run begins."""
