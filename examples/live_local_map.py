"""Replay a drive through the live mapper, and measure how long each call takes.

python examples/live_local_map.py DRIVE [--labels FOLDER | --model MODEL] [--out PICTURE.png]

Sweeps and images are handed over in the order of their time, as a vehicle would. Prints the
median and the worst of each kind of call beside the time that the sensor leaves for it. The
picture is the last local map: most probable classes, the vehicle's nose up.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from hdmap_tools.config import Config
from hdmap_tools.errors import HDMapError
from hdmap_tools.frame_source import frame_key
from hdmap_tools.live import LiveMapper
from hdmap_tools.opening import open_for
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.view.canvas import write_png
from hdmap_tools.view.local_and_global import local_panel

_PX_A_METRE = 20.0


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drive", type=Path)
    parser.add_argument("--labels", type=Path, help="label images made before")
    parser.add_argument("--model", help="network, by default the one that ships")
    parser.add_argument("--out", type=Path, help="picture of the last local map")
    parser.add_argument("--resolution", type=float, default=0.2, help="metres")
    given = parser.parse_args()
    try:
        replay(given)
    except HDMapError as error:
        parser.exit(1, f"{error}\n")


def replay(given: argparse.Namespace) -> None:
    """All frames of a drive, one after the other."""
    segmentation = {"labels": given.labels} if given.labels else {"model": given.model}
    config = Config.model_validate(
        {"segmentation": segmentation, "fusion": {"resolution_m": given.resolution}}
    )
    drive = open_for(config, given.drive)
    segmenter = open_segmenter(config.segmentation, drive)
    mapper = LiveMapper(
        drive.cameras,
        segmenter.label_set,
        model=segmenter.name,
        confusion=confusion_of(segmenter),
        config=config,
    )
    taken_s: dict[str, list[float]] = defaultdict(list)
    events = [(image.timestamp_ns, 1, image) for image in drive.images]
    events += [(sweep.timestamp_ns, 0, sweep) for sweep in drive.sweeps]
    for timestamp_ns, _, event in sorted(events, key=lambda e: e[:2]):
        pose = drive.trajectory.interpolate(timestamp_ns, config.drive.max_pose_gap_s)
        if hasattr(event, "camera"):
            begin = time.perf_counter()
            labels = segmenter.segment(event)
            segmented = time.perf_counter()
            mapper.add_image(event.camera, labels, pose, frame_key(event))
            added = time.perf_counter()
            mapper.window()
            taken_s["segment an image"].append(segmented - begin)
            taken_s["add an image"].append(added - segmented)
            taken_s["read the map"].append(time.perf_counter() - added)
        else:
            sweep = drive.read_sweep(event)
            begin = time.perf_counter()
            mapper.add_sweep(sweep, pose)
            taken_s["add a sweep"].append(time.perf_counter() - begin)
    for what, seconds in taken_s.items():
        # The first call pays for loading what is compiled.
        ms = 1000.0 * np.array(seconds[1:] or seconds)
        print(
            f"{what:18} median {np.median(ms):6.1f} ms, worst {ms.max():6.1f} ms, {len(ms)} times"
        )
    if given.out is not None:
        local_SE3_ego = mapper.city_SE3_local.inverse() @ pose
        write_png(
            local_panel(mapper.window(), local_SE3_ego, _PX_A_METRE), given.out, overwrite=True
        )


if __name__ == "__main__":
    main()
