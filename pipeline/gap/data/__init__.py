"""Records prepared for fitting: which are used, training or held out, where a run begins."""
