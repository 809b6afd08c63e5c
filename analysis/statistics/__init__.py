"""Statistics: estimates with intervals, metrics of trials, cumulative cost, and the paper's claims."""
