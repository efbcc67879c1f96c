"""From pixels to cells: which map cell each label of an image speaks about.

One module a method, each with one function that gives `Observations`: `surface`,
`sparse` and `planar`. What works from a prebuilt point map has its place beside them.
"""
