"""Vectorizing a map window by window: in bounded memory, the seams invisible."""
