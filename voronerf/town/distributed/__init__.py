"""Joint training of one run by several processes, the ranks of ``torchrun``; each holds its own cells."""
