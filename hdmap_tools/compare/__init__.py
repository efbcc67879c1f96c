"""Holding a result against maps that already exist."""
