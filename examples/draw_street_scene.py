"""Draw a made street as the vectorizers see it: probabilities on the left, vectors on the right.

python examples/draw_street_scene.py street_scene.png
"""

import argparse
from pathlib import Path

import numpy as np

from hdmap_tools.testing.scenes import street_scene
from hdmap_tools.vectorization import vectorize
from hdmap_tools.view.overview import Panel, overview_picture

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("picture", type=Path, help="PNG to write, for example street_scene.png")
arguments = parser.parse_args()

window = street_scene(resolution_m=0.1, angle_deg=20.0, noise=0.6, rng=np.random.default_rng(7))
result = vectorize(window)
overview_picture(
    arguments.picture,
    [
        Panel("semantic map", window),
        Panel("vectors", window, result.vector_map),
    ],
    title="A made street: from probabilities to map elements",
    overwrite=True,
)
for name, number in result.vector_map.counts().items():
    print(f"{number} {name}")
