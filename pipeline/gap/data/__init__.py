"""Records made ready: what is used, who teaches and who judges, where a run begins."""
