"""Judge policies: equal flights for all, metrics, bootstrap intervals, reports."""
