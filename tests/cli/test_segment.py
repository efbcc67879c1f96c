"""`hdmap segment`: its folder says by itself what is in it."""

import json

from hdmap_tools.fusion.semantic_map import SemanticMap

from .conftest import LABELS


def test_labels_are_used_without_being_told_what_they_mean(street, hdmap):
    # Labels from elsewhere say nothing, so what they mean has to be given.
    code, _, err = hdmap("segment", "drive", "-o", "bare", "--labels", "labels")
    assert code == 1
    assert "--label-set" in err
    code, out, err = hdmap("segment", "drive", "-o", "made", *LABELS)
    assert code == 0, err
    assert "3 label images of precomputed (adas-0001)" in out
    (street / "made" / "model.json").write_text(json.dumps({"model": "my-net"}))
    for name, more in (("plain", LABELS), ("told", ("--labels", "made"))):
        code, _, err = hdmap("build", "drive", "-o", name, *more)
        assert code == 0, err
    plain, told = (SemanticMap.open(street / name) for name in ("plain", "told"))
    assert (plain.meta.model, told.meta.model) == ("precomputed", "my-net")
    assert told.meta.label_set == plain.meta.label_set
    # What made them goes on to labels made of labels.
    code, _, err = hdmap("segment", "drive", "-o", "again", "--labels", "made")
    assert code == 0, err
    assert json.loads((street / "again" / "model.json").read_text()) == {"model": "my-net"}
