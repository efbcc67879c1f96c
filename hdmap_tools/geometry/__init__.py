"""Poses, cameras, grids and the map's place on earth."""
