"""Importing open3d on a machine without libusb-1.0, which its library links to."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any


@cache
def open3d() -> Any:
    """The module `open3d`; imported on first use, for it takes most of a second.

    The wheel `libusb-package` carries the library that a bare machine lacks; loaded
    first and for all to see, the dynamic linker takes it.
    """
    import libusb_package

    library = libusb_package.get_library_path()
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
