import numpy as np
import pytest
import shapely

from hdmap_tools.errors import WorldError
from hdmap_tools.open3d_import import open3d
from hdmap_tools.simulate import furniture, vehicles
from hdmap_tools.simulate.build_scene import SceneBuilder, build_scene
from hdmap_tools.simulate.materials import MATERIALS, Mat
from hdmap_tools.simulate.scene import Mesh, Scene
from hdmap_tools.simulate.settings import Difficulty, SimulationSettings
from hdmap_tools.simulate.traffic import build_actors
from tests.simulate.small_worlds import LANE_M, bend, curved_street, street_route

HARD = SimulationSettings(seed=3, difficulty=Difficulty.HARD)


@pytest.fixture(scope="module")
def builder() -> SceneBuilder:
    return SceneBuilder(curved_street(), HARD)


@pytest.fixture(scope="module")
def scene(builder: SceneBuilder) -> Scene:
    return builder.scene(street_route(), (60.0, 110.0))


def cast_down(mesh: Mesh, xy: np.ndarray, from_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Height and material of the first thing below each point, in the mesh's frame."""
    o3d = open3d()
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles))
    rays = np.column_stack(
        [xy, np.full(len(xy), from_m), np.zeros((len(xy), 2)), np.full(len(xy), -1.0)]
    )
    hits = caster.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
    distance = hits["t_hit"].numpy().astype(np.float64)
    ids = hits["primitive_ids"].numpy()
    materials = np.where(
        np.isfinite(distance), mesh.materials[np.minimum(ids, len(mesh.materials) - 1)], Mat.SKY
    )
    return from_m - distance, materials


def ground_of(scene: Scene) -> Mesh:
    is_ground = np.isin(scene.static.materials, [Mat.GROUND, Mat.KERB])
    return Mesh(
        scene.static.vertices, scene.static.triangles[is_ground], scene.static.materials[is_ground]
    )


def test_the_road_lies_on_the_terrain_and_the_pavement_a_kerb_higher(builder, scene) -> None:
    rng = np.random.default_rng(0)
    s = rng.uniform(60, 90, 4000)
    ground = ground_of(scene)
    for left, raise_m in (
        (rng.uniform(-3.49, 3.49, 4000), 0.0),
        (-LANE_M - 0.3, 0.12),
        (LANE_M + 0.3, 0.03),
    ):
        xy = bend(s, left)
        height, material = cast_down(ground, xy - scene.origin_city[:2], 50.0)
        assert (material == Mat.GROUND).all()
        expected = builder.terrain.height_at(xy) + raise_m - scene.origin_city[2]
        np.testing.assert_allclose(height, expected, atol=0.003)


def test_the_ground_has_no_cracks(builder, scene) -> None:
    # Densely over the right kerb, where road, face and pavement meet, and over tile borders.
    s, left = (
        a.ravel() for a in np.meshgrid(np.arange(70, 90, 0.05), np.arange(-4.0, -3.0, 0.004))
    )
    xy = bend(s, left)
    height, material = cast_down(ground_of(scene), xy - scene.origin_city[:2], 50.0)
    assert (material != Mat.SKY).all()
    above = height - builder.terrain.height_at(xy) + scene.origin_city[2]
    assert above.min() > -0.003
    assert above.max() < 0.123


def test_kerb_faces_stop_rays_that_come_from_the_road(scene, builder) -> None:
    o3d = open3d()
    ground = ground_of(scene)
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(ground.vertices), o3d.core.Tensor(ground.triangles))
    s = np.linspace(65, 90, 500)
    start, end = bend(s, -LANE_M + 1.0), bend(s, -LANE_M - 0.5)
    z = builder.terrain.height_at(bend(s, -LANE_M)) + 0.06
    origins = np.column_stack([start, z]) - scene.origin_city
    rays = np.column_stack([origins, end - start, np.zeros(len(s))]).astype(np.float32)
    hits = caster.cast_rays(o3d.core.Tensor(rays))
    assert (ground.materials[hits["primitive_ids"].numpy()] == Mat.KERB).all()
    np.testing.assert_allclose(hits["t_hit"].numpy() * 1.5, 1.0, atol=0.02)
    # Faces look at the road.
    towards = (hits["primitive_normals"].numpy() * rays[:, 3:]).sum(axis=1)
    assert (towards < 0).all()


def test_scenes_that_overlap_agree(builder, scene) -> None:
    other = SceneBuilder(curved_street(), HARD).scene(street_route(), (90.0, 130.0))
    a, b = scene.surface, other.surface
    x0, y0 = max(a.grid.x_min, b.grid.x_min), max(a.grid.y_min, b.grid.y_min)
    x1, y1 = min(a.grid.x_max, b.grid.x_max), min(a.grid.y_max, b.grid.y_max)
    cut_a, cut_b = (
        r.codes[y0 - r.grid.y_min : y1 - r.grid.y_min, x0 - r.grid.x_min : x1 - r.grid.x_min]
        for r in (a, b)
    )
    both = (cut_a > 0) & (cut_b > 0)
    assert both.sum() > 1e7
    np.testing.assert_array_equal(cut_a[both], cut_b[both])
    # All that stands within 50 m of a place both stretches hold.
    sets = []
    for one in (scene, other):
        centres = one.static.vertices[one.static.triangles].mean(axis=1) + one.origin_city
        near = np.hypot(*(centres[:, :2] - bend(np.array([115.0]), 0.0)).T) < 45.0
        stands = ~np.isin(one.static.materials, [Mat.GROUND, Mat.KERB, Mat.GRASS, Mat.ASPHALT])
        chosen = centres[near & stands]
        sets.append(chosen[np.lexsort(np.round(chosen, 2).T)])
    assert len(sets[0]) == len(sets[1]) > 1000
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(sets[0]).query(sets[1])
    assert distance.max() < 1e-3


def test_drives_of_one_place_share_all_but_what_comes_and_goes(scene) -> None:
    other_day = HARD.model_copy(update={"seed": 77, "world_seed": HARD.seed})
    same = build_scene(curved_street(), street_route(), (60.0, 110.0), other_day)
    np.testing.assert_array_equal(same.surface.codes, scene.surface.codes)
    np.testing.assert_array_equal(same.surface.wear, scene.surface.wear)

    def standing(one: Scene) -> set[tuple[float, ...]]:
        vehicles_are = [m for m, one in MATERIALS.items() if one.label in ("car", "bus", "truck")]
        kept = ~np.isin(one.static.materials, vehicles_are)
        corners = one.static.vertices[one.static.triangles[kept]].mean(axis=1)
        return {tuple(corner) for corner in np.round(corners, 2).tolist()}

    assert standing(same) == standing(scene)
    elsewhere = HARD.model_copy(update={"seed": 77})
    assert not np.array_equal(
        build_scene(curved_street(), street_route(), (60.0, 110.0), elsewhere).surface.wear,
        scene.surface.wear,
    )


def test_one_builder_and_a_fresh_one_give_the_same_bytes(builder) -> None:
    fresh = build_scene(curved_street(), street_route(), (100.0, 104.0), HARD)
    used = builder.scene(street_route(), (100.0, 104.0))
    np.testing.assert_array_equal(fresh.static.vertices, used.static.vertices)
    np.testing.assert_array_equal(fresh.static.triangles, used.static.triangles)
    np.testing.assert_array_equal(fresh.surface.codes, used.surface.codes)


def test_only_vehicles_stand_on_the_road_and_they_keep_the_route_clear(builder, scene) -> None:
    is_car = np.array(
        [mat in MATERIALS and MATERIALS[Mat(mat)].label == "car" for mat in range(256)]
    )
    is_ground = np.isin(scene.static.materials, [Mat.GROUND, Mat.KERB, Mat.GRASS, Mat.ASPHALT])
    corners = scene.static.vertices[scene.static.triangles].astype(np.float64) + scene.origin_city
    middle = np.arange(0.0, 200.0, 1.0)
    road = shapely.LineString(bend(middle, 0.0)).buffer(LANE_M - 0.02, cap_style="flat")
    low = corners[..., 2].min(axis=1) - builder.terrain.height_at(corners[:, 0, :2]) < 2.2
    other = corners[low & ~is_ground & ~is_car[scene.static.materials]].reshape(-1, 3)
    assert len(other) > 1000
    assert not shapely.contains_xy(road, other[:, :2]).any()
    cars = corners[is_car[scene.static.materials]].reshape(-1, 3)
    assert len(cars) > 1000
    route = shapely.LineString(street_route().xy)
    assert shapely.distance(route, shapely.points(cars[:, :2])).min() > 2.29


@pytest.mark.parametrize(
    "shape",
    [
        furniture.box((0, 0, 0), (1, 2, 3), Mat.WALL),
        furniture.tree(8.0, np.random.default_rng(0)),
        furniture.hedge(5.0, 1.0, np.random.default_rng(0)),
        *(vehicles.car(np.random.default_rng(k))[0] for k in range(8)),
        vehicles.truck(np.random.default_rng(0))[0],
        vehicles.person(np.random.default_rng(0)),
        vehicles.cyclist(np.random.default_rng(0)),
    ],
)
def test_shapes_are_wound_outwards_and_stand_on_the_ground(shape: Mesh) -> None:
    corners = shape.vertices[shape.triangles].astype(np.float64)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume > 0
    assert -0.31 <= shape.vertices[:, 2].min() < 0.08


def test_vehicles_are_as_long_as_they_say() -> None:
    for made in (*(vehicles.car(np.random.default_rng(k)) for k in range(10)), vehicles.bus()):
        mesh, (length, width) = made
        spans = np.ptp(mesh.vertices, axis=0)
        assert spans[0] == pytest.approx(length, abs=0.1)
        assert spans[1] == pytest.approx(width, abs=0.4)  # mirrors
        assert 100 < len(mesh.triangles) < 1000


@pytest.mark.parametrize("seed", range(3))
def test_nobody_meets_the_vehicle_that_drives(seed: int) -> None:
    route = street_route()
    times = np.arange(0.0, 30.0, 0.5)
    arc = np.minimum(times * 8.0, 235.0)
    settings = HARD.model_copy(update={"seed": seed})
    actors = build_actors(curved_street(), route, times, arc, settings)
    assert len(actors) >= 5
    labels = {MATERIALS[Mat(m)].label for a in actors for m in a.mesh.materials}
    assert {"car", "person"} <= labels
    for t in np.arange(0.0, 30.0, 0.25):
        k = min(int(np.interp(t, times, arc) / route.step_m), len(route.xy) - 2)
        ahead = route.xy[k + 1] - route.xy[k]
        ahead /= np.linalg.norm(ahead)
        left = np.array([-ahead[1], ahead[0]])
        at = route.xy[k]
        ego = shapely.Polygon(
            [
                at + ahead * u + left * v
                for u, v in ((-1, -0.95), (3.8, -0.95), (3.8, 0.95), (-1, 0.95))
            ]
        )
        for actor in actors:
            xyz, yaw = actor.place_at(float(t))
            body = furniture.moved(actor.mesh, xyz - [*at, 0.0], yaw).vertices[:, :2] + at
            assert ego.distance(shapely.MultiPoint(body).convex_hull) > 0.1


def test_scenes_take_the_actors_that_come_near(builder) -> None:
    route = street_route()
    times = np.arange(0.0, 30.0, 0.5)
    actors = build_actors(curved_street(), route, times, times * 7.0, HARD)
    assert set(builder.scene(route, (0.0, 20.0), actors).actors) <= set(actors)


def test_a_stretch_off_the_route_is_refused(builder) -> None:
    with pytest.raises(WorldError, match=r"5000.* m does not meet the route, which is 2\d\d"):
        builder.scene(street_route(), (5000.0, 5100.0))
