"""`hdmap demo`: a short one."""

import re

import pytest


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


@pytest.mark.slow
def test_it_makes_what_it_names_and_replaces_it_only_when_asked(hdmap, fails, here):
    code, out, err = hdmap("demo", "--length-m", "40")
    assert code == 0, err
    assert "SIMULATED" in out
    named = {word.rstrip(".,;:") for word in re.findall(r"demo/[\w./-]+", out)}
    assert {"demo/drive", "demo/drive/truth", "demo/map/lanelet2_map.osm"} <= named
    for name in named:
        assert (here / name).exists(), name
    pictures = sorted((here / "demo" / "map").glob("*.png"))
    assert pictures  # "beside it"
    assert all(path.stat().st_size > 10_000 for path in pictures)
    assert sorted(p.name for p in (here / "demo").iterdir()) == ["drive", "map"]
    before = (here / "demo/map/lanelet2_map.osm").read_bytes()

    fails("demo", "--length-m", "40", says=("demo/drive", "--overwrite"))
    assert (here / "demo/map/lanelet2_map.osm").read_bytes() == before
    code, _, err = hdmap("demo", "--length-m", "40", "--overwrite")
    assert code == 0, err
    assert (here / "demo/map/lanelet2_map.osm").read_bytes() == before
    assert sorted(p.name for p in (here / "demo").iterdir()) == ["drive", "map"]


def test_a_folder_of_others_is_refused_before_anything_is_simulated(fails, here):
    (here / "demo" / "map").mkdir(parents=True)
    (here / "demo" / "map" / "mine.txt").write_text("keep")
    fails("demo", "--overwrite", says=("demo/map", "left alone"))
    assert (here / "demo/map/mine.txt").read_text() == "keep"
    assert not (here / "demo" / "drive").exists()


def test_a_length_that_cannot_be_is_said(fails, here):
    fails("demo", "--length-m", "3", says=("length_m",))
    fails("demo", "--seed", "-1", says=("seed",))
    assert list(here.iterdir()) == []
