"""From observations to the probabilistic map: integer counts, and how they are read."""
