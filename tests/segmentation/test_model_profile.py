"""Profiles: shipped, one's own, and found by the hash of the weights."""

import hashlib
import json
import logging

import pytest
from pydantic import ValidationError

from hdmap_tools.errors import ConfigError
from hdmap_tools.labels.label_set import load_label_set
from hdmap_tools.segmentation import model_profile
from hdmap_tools.segmentation.model_profile import (
    builtin_profiles,
    find_profile,
    load_profile,
    profile_for,
    sha256_of_files,
)


@pytest.fixture
def known(tmp_path, make_profile, monkeypatch):
    """A model file whose hash is known."""
    model = tmp_path / "known.onnx"
    model.write_bytes(b"weights")
    profile = make_profile(name="known", sha256=(hashlib.sha256(b"weights").hexdigest(),))
    monkeypatch.setattr(model_profile, "builtin_profiles", lambda: {"known": profile})
    return model


def test_shipped_profiles_name_shipped_label_sets():
    assert "road-segmentation-adas-0001" in builtin_profiles()
    for name, profile in builtin_profiles().items():
        assert profile.name == name
        assert profile.sha256
        assert profile.source
        assert load_label_set(profile.label_set).name == profile.label_set


def test_a_model_is_known_by_its_hash(known, tmp_path):
    assert find_profile(known).name == "known"
    other = tmp_path / "other.onnx"
    other.write_bytes(b"other weights")
    assert find_profile(other) is None
    assert find_profile(tmp_path / "nowhere.onnx") is None


def test_an_openvino_model_is_known_by_its_bin(known, tmp_path):
    (tmp_path / "m.xml").write_text("<net/>")
    (tmp_path / "m.bin").write_bytes(b"weights")
    assert find_profile(tmp_path / "m.xml").name == "known"


def test_a_model_that_is_not_there_is_named(known, tmp_path):
    with pytest.raises(ConfigError, match=r"no model file .*nowhere\.onnx"):
        profile_for(tmp_path / "nowhere.onnx", "known")


def test_a_profile_asked_for_is_used_for_other_weights_with_a_warning(known, tmp_path, caplog):
    other = tmp_path / "other.onnx"
    other.write_bytes(b"other weights")
    with caplog.at_level(logging.WARNING):
        assert profile_for(known, "known").name == "known"
        assert caplog.messages == []
        assert profile_for(other, "known").name == "known"
    assert len(caplog.messages) == 1
    assert "made for other weights" in caplog.text


def test_a_profile_of_ones_own_finds_its_label_set_beside_it(write_profile, label_set, tmp_path):
    (tmp_path / "mine.json").write_text(label_set.model_dump_json())
    path = write_profile(tmp_path / "profile.json", label_set="mine.json")
    assert load_profile(path).label_set == str(tmp_path / "mine.json")
    path = write_profile(tmp_path / "profile.json", label_set="adas-0001")
    assert load_profile(str(path)).label_set == "adas-0001"


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError, match="road-segmentation-adas-0001"):
        load_profile("no-such-profile")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{",
        b"\xff",
        b'{"name": "x"}',
        b"[" * 100_000,
        b'{"name": ' + b"9" * 9000 + b"}",
    ],
)
def test_a_file_that_is_no_profile(content, tmp_path):
    path = tmp_path / "p.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"p\.json is not a model profile") as caught:
        load_profile(path)
    assert "\n" not in str(caught.value)
    assert "pydantic" not in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"scale": 0},
        {"std": [1, 1, 0]},
        {"mean": [0, 0, float("nan")]},
        {"input_size_px": [0, 6]},
        {"sha256": ["abc"]},
        {"channels": "rgba"},
        {"extra": 1},
    ],
)
def test_fields_that_cannot_be_are_refused(wrong, make_profile, tmp_path):
    document = make_profile().model_dump(mode="json") | wrong
    path = tmp_path / "p.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        load_profile(path)


def test_a_profile_is_immutable(make_profile):
    with pytest.raises(ValidationError):
        make_profile().name = "other"


def test_the_hash_is_of_the_bytes_and_of_their_order(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"1")
    b.write_bytes(b"2")
    assert sha256_of_files([a]) == hashlib.sha256(b"1").hexdigest()
    assert len({sha256_of_files([a, b]), sha256_of_files([b, a]), sha256_of_files([a])}) == 3
