"""The complete report of a submission, and what has changed since an earlier report."""
