"""The report of a submission as a whole, and what changed since an earlier one."""
