"""From a drive to an HD map.

Import from the modules: ``from hdmap_tools.geometry.se3 import SE3``.
"""

__version__ = "0.1.0"
