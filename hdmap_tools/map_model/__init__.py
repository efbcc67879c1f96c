"""The vector map: typed elements in one city frame."""
