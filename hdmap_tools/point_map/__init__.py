"""The dense point map: sweeps and poses become thinned tiles without what moved."""
