"""Entries of tables that a step has touched, for the exchange among ranks."""
