"""Sums over the runs of samples that each cell adds to a ray."""
