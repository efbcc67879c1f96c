"""Who moves in a drive: vehicles on their lanes, people on pavements and crossings, cyclists.

Made once for a whole drive, from its seed; scenes take those that come near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

from hdmap_tools.geometry.polyline import arc_lengths, drop_repeats, resample
from hdmap_tools.simulate import vehicles
from hdmap_tools.simulate.location_noise import Purpose, rng_at
from hdmap_tools.simulate.road_area import WorldIndex, block_of
from hdmap_tools.simulate.road_crown import RoadCrown
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.scene import Actor, Mesh
from hdmap_tools.simulate.settings import Difficulty, SimulationSettings
from hdmap_tools.simulate.surface import crossing_direction, lane_centre
from hdmap_tools.simulate.terrain import Terrain
from hdmap_tools.simulate.world_map import WorldLane, WorldMap
from hdmap_tools.types import NDArrayBool, NDArrayFloat

STEP_S: Final = 0.2
EGO_SIZE_M: Final = (5.0, 2.1)
EGO_MIDDLE_M: Final = 1.4
"""Of a car's middle before its rear axle, which the route is of."""

CLEARANCE_M: Final = 0.4

_PER_100_M: Final = {
    # vehicles, people on pavements, cyclists
    Difficulty.EASY: (1.0, 1.5, 0.3),
    Difficulty.DEFAULT: (2.5, 4.0, 0.8),
    Difficulty.HARD: (5.0, 9.0, 1.5),
}
_AT_CROSSING: Final = {Difficulty.EASY: 0.2, Difficulty.DEFAULT: 0.5, Difficulty.HARD: 0.8}
_WALK_MPS: Final = 1.3


@dataclass(frozen=True, eq=False)
class _Motion:
    """Where something is at the times of the drive: xy (K, 2), yaw (K,), and its size."""

    xy: NDArrayFloat
    yaw_rad: NDArrayFloat
    size_m: tuple[float, float]


def build_actors(
    world: WorldMap,
    route: Route,
    ego_times_s: NDArrayFloat,
    ego_arc_m: NDArrayFloat,
    settings: SimulationSettings,
    terrain: Terrain | None = None,
    index: WorldIndex | None = None,
) -> tuple[Actor, ...]:
    """All that moves during a drive; nothing meets the vehicle that drives, or one another.

    Args:
        world: The map.
        route: Where the vehicle drives.
        ego_times_s: (K,) rising seconds of the drive.
        ego_arc_m: (K,) how far along the route it is at these times.
        settings: Seed and difficulty decide who and how many.
        terrain: The ground; by default that of the seed, with the road's crown.
        index: Of the world, where there is one already.
    """
    index = index or WorldIndex(world)
    terrain = terrain or Terrain(settings.place_seed, crown=RoadCrown(index))
    last = float(ego_times_s[-1])
    times = np.arange(float(ego_times_s[0]), last + STEP_S, STEP_S)
    arc = np.interp(times, ego_times_s, ego_arc_m)
    traffic = _Traffic(index, route, times, arc, settings)
    vehicles_per, people_per, cyclists_per = _PER_100_M[settings.difficulty]
    hundreds = float(ego_arc_m[-1] - ego_arc_m[0]) / 100.0
    made = [
        *traffic.ahead(),
        *traffic.on_lanes(round(vehicles_per * hundreds + 1)),
        *traffic.on_lanes(round(cyclists_per * hundreds), is_bicycle=True),
    ]
    made += traffic.on_crossings(_AT_CROSSING[settings.difficulty])
    made += traffic.on_pavements(round(people_per * hundreds))
    return tuple(
        Actor(
            mesh,
            times,
            np.column_stack([motion.xy, _ground(motion.xy, index, terrain)]),
            motion.yaw_rad,
        )
        for mesh, motion in made
    )


class _Traffic:
    def __init__(
        self,
        index: WorldIndex,
        route: Route,
        times: NDArrayFloat,
        arc: NDArrayFloat,
        settings: SimulationSettings,
    ) -> None:
        self.index = index
        self.route = route
        self.times = times
        self.arc = arc
        self.seed = settings.seed
        self.lanes = {lane.id: lane for lane in index.road_lanes}
        path = _Path(route.xy)
        self.ego = _Motion(*path.at(arc + EGO_MIDDLE_M), EGO_SIZE_M)
        self.taken = [self.ego]
        self.near = shapely.LineString(route.xy[:: max(len(route.xy) // 400, 1)]).buffer(70.0)

    def ahead(self) -> list[tuple[Mesh, _Motion]]:
        """A vehicle on the same way, at a varying distance."""
        rng = rng_at(self.seed, Purpose.TRAFFIC, 1)
        xy = self.route.xy
        for lane_id in self._onward(self.route.lane_ids[-1], rng, 200.0)[1:]:
            xy = np.concatenate([xy, lane_centre(self.lanes[lane_id], 0.5)])
        path = _Path(xy)
        gap = float(rng.uniform(24, 40)) + 8.0 * np.sin(
            self.times / float(rng.uniform(5, 9)) + float(rng.uniform(0, 6))
        )
        # Never backwards: where the gap shrinks faster than the drive goes on, it waits.
        at = np.maximum.accumulate(self.arc + gap)
        mesh, size = self._vehicle(rng)
        motion = _Motion(*path.at(at), size)
        return self._accept(mesh, motion)

    def on_lanes(self, count: int, is_bicycle: bool = False) -> list[tuple[Mesh, _Motion]]:
        """Vehicles that follow lanes near the route, mostly not the route's own."""
        made: list[tuple[Mesh, _Motion]] = []
        own = set(self.route.lane_ids)
        starts = [
            lane
            for lane in self.index.lanes_near(self.near)
            if lane.id not in own and (is_bicycle or lane.kind == "road")
        ]
        if not starts:
            return made
        for k in range(12 * count):
            if len(made) >= count:
                break
            rng = rng_at(self.seed, Purpose.TRAFFIC, 2 + is_bicycle, k)
            start = starts[int(rng.integers(len(starts)))]
            speed = float(rng.uniform(3.5, 5.5) if is_bicycle else rng.uniform(6.0, 11.0))
            reach = speed * (float(self.times[-1] - self.times[0]) + 10.0)
            lanes = self._onward(start.id, rng, min(reach, 400.0))
            path = _Path(self._line(lanes, is_bicycle))
            # It passes the middle of its way when the drive passes by there.
            meet = path.points[len(path.points) // 3]
            ego = self.ego.xy
            passing = float(self.times[np.argmin(np.hypot(*(ego - meet).T))])
            passing += float(rng.uniform(-4, 4))
            at = path.length_m / 3 + speed * (self.times - passing)
            if is_bicycle:
                mesh, size = vehicles.cyclist(rng), (1.8, 0.7)
            else:
                mesh, size = self._vehicle(rng)
            made += self._accept(mesh, _Motion(*path.at(at), size))
        return made

    def on_pavements(self, count: int) -> list[tuple[Mesh, _Motion]]:
        """People who walk along the kerb near where the drive passes."""
        made: list[tuple[Mesh, _Motion]] = []
        for k in range(4 * count):
            if len(made) >= count:
                break
            rng = rng_at(self.seed, Purpose.PEOPLE, 1, k)
            at_time = float(rng.uniform(self.times[0], self.times[-1]))
            place = self.ego.xy[np.searchsorted(self.times, at_time)]
            ahead = float(rng.uniform(0, 2 * np.pi))
            place = place + float(rng.uniform(4, 25)) * np.array([np.cos(ahead), np.sin(ahead)])
            area = self.index.road_area(block_of(place))
            beside = shapely.boundary(area.drivable.buffer(float(rng.uniform(0.9, 2.0))))
            rings = shapely.get_parts(beside)
            if len(rings) == 0:
                continue
            ring = rings[int(np.argmin(shapely.distance(rings, shapely.Point(place))))]
            middle = float(shapely.line_locate_point(ring, shapely.Point(place)))
            direction = 1.0 if rng.uniform() < 0.5 else -1.0
            speed = _WALK_MPS * float(rng.uniform(0.7, 1.2))
            since = np.clip(self.times - at_time, -15.0, 15.0)
            along = middle + direction * speed * since
            if along.min() < 0 or along.max() > ring.length:
                continue
            points = shapely.get_coordinates(shapely.line_interpolate_point(ring, along))
            if np.hypot(*(points - place).T).max() > 38.0:  # beyond what the block knows
                continue
            yaw = _yaw_of(ring, along, direction)
            made += self._accept(vehicles.person(rng), _Motion(points, yaw, (0.6, 0.6)))
        return made

    def on_crossings(self, chance: float) -> list[tuple[Mesh, _Motion]]:
        """People who cross before the drive comes by."""
        made: list[tuple[Mesh, _Motion]] = []
        crossings = self.index.world.crosswalks
        for k in np.sort(self.index.crosswalk_tree.query(self.near, predicate="intersects")):
            rng = rng_at(self.seed, Purpose.PEOPLE, 2, int(k))
            if rng.uniform() > chance:
                continue
            ahead = crossing_direction(self.index, crossings[k])
            across = np.array([-ahead[1], ahead[0]]) * (1 if rng.uniform() < 0.5 else -1)
            middle = np.array([crossings[k].centroid.x, crossings[k].centroid.y])
            half = float(np.abs((shapely.get_coordinates(crossings[k]) - middle) @ across).max())
            distance = np.hypot(*(self.ego.xy - middle).T)
            done = float(self.times[np.argmin(distance)]) - float(rng.uniform(4, 7))
            since = np.clip((self.times - done) * _WALK_MPS, -2 * half - 3.0, 3.0)
            path = middle + np.outer(since + half + 0.0, across)
            yaw = np.full(len(path), np.arctan2(across[1], across[0]))
            made += self._accept(vehicles.person(rng), _Motion(path, yaw, (0.6, 0.6)))
        return made

    def _vehicle(self, rng: np.random.Generator) -> tuple[Mesh, tuple[float, float]]:
        kind = rng.uniform()
        if kind < 0.08:
            return vehicles.truck(rng)
        if kind < 0.13:
            return vehicles.bus()
        return vehicles.car(rng)

    def _onward(self, lane_id: str, rng: np.random.Generator, reach_m: float) -> list[str]:
        """The lane and seeded successors until they are that long, or end."""
        lanes, length = [lane_id], 0.0
        while length < reach_m:
            lane = self.lanes.get(lanes[-1])
            if lane is None:
                break
            length += float(arc_lengths(lane.left)[-1])
            following = [s for s in lane.successors if s in self.lanes and s not in lanes]
            if not following:
                break
            lanes.append(following[int(rng.integers(len(following)))])
        return lanes

    def _line(self, lane_ids: list[str], is_bicycle: bool) -> NDArrayFloat:
        """(N, 2) along lanes; bicycles keep to the right."""
        lanes: list[WorldLane] = [self.lanes[k] for k in lane_ids]
        share = 0.75 if is_bicycle else 0.5
        return np.concatenate([lane_centre(lane, 0.5, share) for lane in lanes])

    def _accept(self, mesh: Mesh, motion: _Motion) -> list[tuple[Mesh, _Motion]]:
        """The thing, unless it would come too near to one that is there already."""
        if any(_meet(motion, other).any() for other in self.taken):
            return []
        self.taken.append(motion)
        return [(mesh, motion)]


class _Path:
    """A smooth way through lanes; beyond its ends it goes straight on."""

    def __init__(self, xy: NDArrayFloat) -> None:
        from scipy.ndimage import gaussian_filter1d

        even = resample(drop_repeats(xy, 1e-3), 0.5)
        self.points = (
            gaussian_filter1d(even, 3.0, axis=0, mode="nearest") if len(even) > 2 else even
        )
        self._along = arc_lengths(self.points)
        self.length_m = float(self._along[-1])

    def at(self, arc_m: NDArrayFloat) -> tuple[NDArrayFloat, NDArrayFloat]:
        """(K, 2) positions and (K,) unwrapped headings at arc lengths."""
        steps = np.diff(self.points, axis=0)
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        middle = (self._along[:-1] + self._along[1:]) / 2
        yaw = np.interp(arc_m, middle, heading)
        xy = np.column_stack([np.interp(arc_m, self._along, self.points[:, d]) for d in (0, 1)])
        beyond = arc_m - np.clip(arc_m, 0.0, self.length_m)
        # Streets go on for a while beyond the map's edge; there it stops.
        beyond = np.clip(beyond, -40.0, 40.0)
        return xy + beyond[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), yaw


def _meet(one: _Motion, other: _Motion) -> NDArrayBool:
    """(K,) whether two things come nearer than `CLEARANCE_M`; each is a row of discs."""
    reach = (sum(one.size_m) + sum(other.size_m)) / 2 + CLEARANCE_M
    near: NDArrayBool = np.hypot(*(one.xy - other.xy).T) < reach
    result = near.copy()
    if near.any():
        a, ra = _discs(one, near)
        b, rb = _discs(other, near)
        gap = np.linalg.norm(a[:, :, None] - b[:, None, :], axis=-1) - ra - rb
        result[near] = gap.min(axis=(1, 2)) < CLEARANCE_M
    return result


def _discs(motion: _Motion, chosen: NDArrayBool) -> tuple[NDArrayFloat, float]:
    """(K, discs, 2) centres that cover the outline, and their radius."""
    length, width = motion.size_m
    n = max(int(np.ceil(length / width * 1.5)), 1)
    ahead = (np.arange(n) + 0.5) / n * length - length / 2
    yaw = motion.yaw_rad[chosen]
    heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
    centres = motion.xy[chosen][:, None] + ahead[None, :, None] * heading[:, None]
    return centres, float(np.hypot(width / 2, length / n / 2))


def _yaw_of(ring: shapely.LineString, along: NDArrayFloat, direction: float) -> NDArrayFloat:
    before = shapely.get_coordinates(
        shapely.line_interpolate_point(ring, np.maximum(along - 0.3, 0))
    )
    after = shapely.get_coordinates(shapely.line_interpolate_point(ring, along + 0.3))
    step = (after - before) * direction
    return np.unwrap(np.arctan2(step[:, 1], step[:, 0]))


def _ground(xy: NDArrayFloat, index: WorldIndex, terrain: Terrain) -> NDArrayFloat:
    """(N,) height of the ground, kerbs raised."""
    height = terrain.height_at(xy)
    blocks = np.array([block_of(p) for p in xy])
    for block in np.unique(blocks, axis=0):
        mine = (blocks == block).all(axis=1)
        area = index.road_area((int(block[0]), int(block[1])))
        off = ~shapely.intersects_xy(area.prepared, xy[mine])
        height[mine] += np.where(off, area.raise_at(xy[mine]), 0.0)
    return height
