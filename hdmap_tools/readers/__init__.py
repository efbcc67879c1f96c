"""Drives on disk: one module a layout, all giving the same `Drive`."""
