"""`hdmap compare`: options that would have no effect are refused."""


def test_a_range_needs_the_driven_path(hdmap, tmp_path):
    code, _, err = hdmap("compare", tmp_path / "map", tmp_path / "mask.png", "--max-range", "25")
    assert code == 2
    assert "--drive" in err


def test_a_range_with_a_drive_is_taken(fails, tmp_path):
    fails(
        "compare", tmp_path / "map", tmp_path / "mask.png", "--max-range", "25", "--drive", tmp_path,
        says=("map",),
    )  # fmt: skip
