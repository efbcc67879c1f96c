"""Builds spread over workers: segments are counted apart, tiles summed, one process commits."""
