"""Reading and writing maps: GeoPackage (the working file), GeoJSON and Lanelet2 OSM.

Every writer is atomic (`atomic`), deterministic (same map, same bytes) and checks
the temporary file before it takes the name of the output. `by_name` picks the
format from a file's suffix or a format's name.
"""
