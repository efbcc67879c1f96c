"""Simulated drives through real maps: exact truth for plugin authors and mappers.

WORLD (Lanelet2, AV2) ──► WorldMap ──► Route ──► Scene (a piece of the route)
                                                   │
                      sensors (camera, lidar) ◄────┘ ──► Argoverse 2 sensor log + truth/
"""
