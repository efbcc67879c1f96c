"""The recipe of the network that ships: its worlds, its parts, and what it says was made."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from hdmap_tools.readers.av2 import read_av2
from hdmap_tools.segmentation.known_confusion import confusion_of
from hdmap_tools.segmentation.measure_confusion import measure_confusion
from hdmap_tools.segmentation.open_segmenter import open_model
from hdmap_tools.segmentation.shipped import shipped_network
from hdmap_tools.segmentation.training.pairs import open_drives, relabelled
from hdmap_tools.simulate.read_world import read_world
from hdmap_tools.simulate.settings import SimulationSettings

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
RECIPE = EXAMPLES / "train_street_small.py"
SHIPPED = ROOT / "hdmap_tools" / "segmentation" / "networks" / "street-small.recipe.json"


@pytest.fixture(scope="module")
def recipe():
    """The script as a module; it imports its neighbours by name, as scripts do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        import train_street_small

        yield train_street_small


@pytest.fixture(scope="module")
def scripted(recipe):
    import make_scripted_town

    return make_scripted_town.town


def by_part(recipe):
    drives = recipe.all_drives()
    return {part: [d for d in drives if d.part == part] for part in recipe.PARTS}


def test_no_part_shares_a_map_or_a_seed_with_another(recipe):
    parts = by_part(recipe)
    assert all(parts.values())
    for what in (lambda d: d.world, lambda d: d.settings["seed"]):
        seen = [value for drives in parts.values() for value in {what(d) for d in drives}]
        assert len(seen) == len(set(seen))
    assert {d.world for d in parts["test"]} == {"demo_town"}


def test_every_part_has_all_weathers_difficulties_and_rigs(recipe):
    for drives in by_part(recipe).values():
        settings = [SimulationSettings.model_validate(d.settings) for d in drives]
        assert len({s.weather for s in settings}) == 5
        assert len({s.difficulty for s in settings}) == 3
        assert len({s.camera_rig for s in settings}) == 3
        assert len({d.name for d in drives}) == len(drives)


def test_no_world_is_seen_in_one_weather_or_by_one_rig_alone(recipe):
    drives = by_part(recipe)["train"]
    for world in {d.world for d in drives}:
        own = [d.settings for d in drives if d.world == world]
        assert len({s["weather"] for s in own}) >= 4
        assert len({s["difficulty"] for s in own}) == 3
        assert len({s["camera_rig"] for s in own}) >= 2


def test_what_ships_says_the_very_recipe(recipe, scripted):
    data = json.loads(SHIPPED.read_text())["data"]
    drives = recipe.all_drives()
    assert data["recipe_sha256"] == recipe.recipe_sha256(data["maps_sha256"], drives)
    assert set(data["maps_sha256"]) == {d.world for d in drives}
    assert data["maps_sha256"]["mapping_example"] == recipe.MAPPING_EXAMPLE_SHA256
    for part, own in by_part(recipe).items():
        assert data[part]["drives"] == len(own)
        assert data[part]["worlds"] == sorted({d.world for d in own})
        assert data[part]["weather"] == dict(Counter(d.settings["weather"] for d in own))


def test_the_file_is_the_one_that_was_measured(recipe):
    measured = json.loads(SHIPPED.read_text())["measured"]
    network = shipped_network("street-small")
    assert recipe.sha256(network) == measured["model"]["sha256"]
    assert network.stat().st_size == measured["model"]["bytes"] <= 5_000_000
    assert measured["iou"]["all"]["lane marking"] >= 0.65
    assert measured["iou"]["all"]["crosswalk"] >= 0.70


def test_it_labels_a_simulated_street(recipe, simulated_drive):
    segmenter = open_model(shipped_network("street-small"), None, {}, threads=2)
    assert segmenter.label_set.name == "street"
    assert confusion_of(segmenter) is not None
    pairs = relabelled(open_drives([simulated_drive]), "street")
    counts = sum(
        measure_confusion(
            [pairs.read(k)], segmenter.segment_rgb, pairs.label_set, segmenter.label_set, ""
        ).counts
        for k in range(len(pairs))
    )
    found = recipe.ious(counts, segmenter.label_set.names)
    assert found["road"] > 0.9
    assert found["sky"] > 0.9


def test_the_towns_are_those_that_the_network_saw(recipe, scripted, tmp_path):
    hashes = json.loads(SHIPPED.read_text())["data"]["maps_sha256"]
    for seed in (recipe.TOWNS[0], recipe.TOWNS[-1]):
        path = tmp_path / f"town_{seed}.osm"
        path.write_text(scripted(seed), encoding="utf-8", newline="\n")
        assert recipe.sha256_of_text(path) == hashes[path.stem]


def test_each_seed_makes_a_town_of_its_own(scripted, tmp_path):
    assert scripted(3) == scripted(3)
    lengths = set()
    for seed in (3, 4):
        path = tmp_path / f"town_{seed}.osm"
        path.write_text(scripted(seed), encoding="utf-8", newline="\n")
        world = read_world(path)
        assert len(world.crosswalks) >= 4
        assert any(line.paint is not None for line in world.lines)
        assert any(lane.kind == "walkway" for lane in world.lanes.values())
        lengths.add(round(sum(len(lane.left) for lane in world.lanes.values())))
    assert len(lengths) == 2


def test_the_lanelet2_library_finds_no_fault_in_a_town(scripted, tmp_path):
    lanelet2 = pytest.importorskip("lanelet2", reason="no lanelet2 wheel for this platform")
    path = tmp_path / "town.osm"
    path.write_text(scripted(7), encoding="utf-8", newline="\n")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(49.012, 8.432))
    loaded, errors = lanelet2.io.loadRobust(str(path), projector)
    assert list(errors) == []
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    assert list(graph.checkValidity(False)) == []
    roads = [lanelet for lanelet in loaded.laneletLayer if rules.canPass(lanelet)]
    reached = max(len(graph.reachableSet(lanelet, 1e6, 0, True)) for lanelet in roads)
    assert reached >= len(roads) - 2


def test_roadgen_makes_the_same_grid_again(recipe, tmp_path):
    pytest.importorskip("roadgen", reason="roadgen is only needed to make the training data")
    import make_roadgen_town

    hashes = json.loads(SHIPPED.read_text())["data"]["maps_sha256"]
    path = tmp_path / "grid_2.osm"
    path.write_text(make_roadgen_town.town(2), encoding="utf-8", newline="\n")
    assert recipe.sha256_of_text(path) == hashes["grid_2"]
    world = read_world(path)
    assert len(world.crosswalks) > 5


def test_another_map_is_not_taken_for_mapping_example(recipe, tmp_path):
    wrong = tmp_path / "mapping_example.osm"
    with pytest.raises(SystemExit, match="There is no map"):
        recipe.make_worlds(tmp_path, wrong)
    wrong.write_text("<osm/>")
    with pytest.raises(SystemExit, match="is not the mapping_example"):
        recipe.make_worlds(tmp_path, wrong)


def test_mapping_example_is_the_one_of_lanelet2(recipe, data_root):
    found = recipe.sha256_of_text(data_root / "lanelet2" / "mapping_example.osm")
    assert found == recipe.MAPPING_EXAMPLE_SHA256


def test_iou_leaves_labels_out_that_nobody_saw(recipe):
    counts = np.array([[6, 2, 0], [0, 4, 0], [0, 0, 0]])
    found = recipe.ious(counts, ("road", "sky", "pole"))
    assert found == {"mean": round((6 / 8 + 4 / 6) / 2, 4), "road": 0.75, "sky": 0.6667}


def test_without_a_command_it_says_how_it_is_used():
    done = subprocess.run([sys.executable, str(RECIPE)], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: train_street_small.py")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_data_is_made_described_and_gone_on_with(recipe, scripted, tmp_path, monkeypatch):
    world = tmp_path / "town.osm"
    world.write_text(scripted(3), encoding="utf-8", newline="\n")
    drives = [recipe.Drive(part, "town_3", k) for k, part in enumerate(recipe.PARTS)]
    monkeypatch.setattr(recipe, "LENGTH_M", 12.0)
    monkeypatch.setattr(recipe, "METRES_BETWEEN", dict.fromkeys(recipe.METRES_BETWEEN, 6.0))
    monkeypatch.setattr(recipe, "all_drives", lambda: drives)
    monkeypatch.setattr(recipe, "make_worlds", lambda *_: {"town_3": world})
    monkeypatch.setattr(recipe, "ProcessPoolExecutor", _InThisProcess)
    out = tmp_path / "out"
    recipe.make_data(out, world, 1)
    first = json.loads((out / "data.json").read_text())
    for drive in drives:
        made = read_av2(out / drive.part / drive.name)
        assert len(made.images) == first[drive.part]["images"] > 0
        assert sum(first[drive.part]["share_of_pixels"].values()) == pytest.approx(100, abs=0.1)
        assert first[drive.part]["share_of_pixels"]["road"] > 10
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.jpg")}
    gone = out / "test" / drives[2].name
    gone.rename(tmp_path / "gone")
    recipe.make_data(out, world, 1)
    assert json.loads((out / "data.json").read_text()) == first
    after = {p: p.stat().st_mtime_ns for p in out.rglob("*.jpg")}
    assert after.keys() == before.keys()
    assert {p for p in after if after[p] != before[p]} == {
        p for p in after if p.is_relative_to(gone)
    }


class _InThisProcess:
    def __init__(self, _):
        self.map = map

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return False
