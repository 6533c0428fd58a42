"""Many clips: a result for each, on one machine, in shares, or on a cluster."""
