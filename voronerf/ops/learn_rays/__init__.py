"""A whole training step of a fused network, over its rays."""
