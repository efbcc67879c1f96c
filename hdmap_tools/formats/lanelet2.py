"""Lanelet2 maps as OSM XML: `write_lanelet2` and `read_lanelet2`."""

from hdmap_tools.formats.lanelet2_read import read_lanelet2
from hdmap_tools.formats.lanelet2_write import to_osm, write_lanelet2

__all__ = ["read_lanelet2", "to_osm", "write_lanelet2"]
