"""One ONNX file is enough: what is written into it comes back, and the model stays the same."""

import json

import numpy as np
import pytest

from hdmap_tools.errors import ConfigError
from hdmap_tools.labels.label_set import Label, LabelSet
from hdmap_tools.segmentation.confusion import ConfusionMatrix
from hdmap_tools.segmentation.embedded import (
    METADATA_KEY,
    EmbeddedModel,
    read_embedded,
    write_embedded,
)
from hdmap_tools.segmentation.onnx_metadata import read_metadata, with_metadata

onnx = pytest.importorskip("onnx")


@pytest.fixture
def embedded(label_set, make_profile):
    counts = np.arange(16).reshape(4, 4)
    return EmbeddedModel(
        profile=make_profile(label_set="colours"),
        label_set=label_set,
        confusion=ConfusionMatrix(label_set, label_set, counts, "made up: ÄÖÜ"),
        training={"drives": ["a", "b"], "epochs": 3, "miou": 0.5},
    )


def test_what_is_written_is_read(embedded, make_onnx, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    assert read_embedded(model) is None
    write_embedded(model, embedded)
    assert read_embedded(model) == embedded
    bare = embedded.model_copy(update={"confusion": None, "training": None})
    write_embedded(model, bare)
    assert read_embedded(model) == bare


def test_onnx_itself_finds_the_document_and_the_same_graph(embedded, make_onnx, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    before = onnx.load(model)
    write_embedded(model, embedded)
    write_embedded(model, embedded)  # in place of the first, not beside it
    after = onnx.load(model)
    assert after.graph == before.graph
    assert [entry.key for entry in after.metadata_props] == [METADATA_KEY]
    document = json.loads(after.metadata_props[0].value)
    assert document["label_set"]["name"] == "colours"
    assert document["confusion"]["counts"][1] == [4, 5, 6, 7]
    del after.metadata_props[:]
    assert after == before


def test_onnx_runtime_finds_it_too(embedded, make_onnx, tmp_path):
    import onnxruntime

    model = make_onnx(tmp_path / "m.onnx")
    write_embedded(model, embedded)
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    found = session.get_modelmeta().custom_metadata_map
    assert found == read_metadata(model)
    assert EmbeddedModel.model_validate_json(found[METADATA_KEY]) == embedded


def test_what_onnx_writes_is_read_and_what_others_say_is_left(embedded, make_onnx, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    proto = onnx.load(model)
    onnx.helper.set_model_props(proto, {"author": "someone", "empty": "", "long": "ä" * 70_000})
    proto.model_version = 1 << 40
    proto.doc_string = "about"
    onnx.save(proto, model)
    said = {"author": "someone", "empty": "", "long": "ä" * 70_000}
    assert read_metadata(model) == said
    write_embedded(model, embedded)
    assert read_metadata(model).keys() == {*said, METADATA_KEY}
    changed = onnx.load(model)
    assert (changed.model_version, changed.doc_string) == (1 << 40, "about")


def test_the_same_document_gives_the_same_bytes(embedded, make_onnx, tmp_path):
    one, two = make_onnx(tmp_path / "1.onnx"), make_onnx(tmp_path / "2.onnx")
    write_embedded(one, embedded)
    write_embedded(two, embedded)
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ("[" * 100_000, "nested too deeply"),
        ("9" * 9000, "is not JSON"),
        ("[]", "cannot be used"),
        ("{}", r"cannot be used: profile: Field required; label_set: Field required"),
    ],
)
def test_a_document_that_cannot_be_used_is_said_so(text, message, make_onnx, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    model.write_bytes(with_metadata(model.read_bytes(), METADATA_KEY, text))
    with pytest.raises(ConfigError, match=message) as caught:
        read_embedded(model)
    assert "m.onnx" in str(caught.value)
    assert "--profile" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["profile"].update(label_set="paz2020"), "names label set 'paz2020'"),
        (lambda d: d["label_set"].update(labels=[]), "needs ids 0..n-1"),
        (lambda d: d["confusion"]["counts"].pop(), r"confusion: .*counts are \(3, 4\)"),
        (lambda d: d["confusion"].update(counts=[[-1] * 4] * 4), "whole numbers of pixels"),
        (lambda d: d.update(profil={}), "profil: Extra"),
        (lambda d: d["profile"].update(std=[0, 1, 1]), "profile.std.0"),
    ],
)
def test_parts_that_do_not_fit_are_named(change, message, embedded, make_onnx, tmp_path):
    document = embedded.model_dump(mode="json")
    change(document)
    model = make_onnx(tmp_path / "m.onnx")
    model.write_bytes(with_metadata(model.read_bytes(), METADATA_KEY, json.dumps(document)))
    with pytest.raises(ConfigError, match=message):
        read_embedded(model)


def test_a_matrix_of_other_labels_is_refused(embedded, label_set):
    other = LabelSet(name="two", labels=label_set.labels[:2])
    matrix = ConfusionMatrix(label_set, other, np.ones((4, 2)))
    with pytest.raises(ValueError, match="predicts the labels of 'two'"):
        EmbeddedModel(profile=embedded.profile, label_set=label_set, confusion=matrix)
    more = LabelSet(
        name="colours", labels=(*label_set.labels, Label(id=4, name="x", color=(1, 2, 3)))
    )
    with pytest.raises(ValueError, match="predicts the labels"):
        EmbeddedModel(profile=embedded.profile, label_set=more, confusion=embedded.confusion)


def test_every_truncation_is_refused_or_reads_the_same(embedded, make_onnx, tmp_path):
    model = make_onnx(tmp_path / "m.onnx")
    write_embedded(model, embedded)
    whole = model.read_bytes()
    short = tmp_path / "short.onnx"
    messages = []
    for length in range(len(whole)):
        short.write_bytes(whole[:length])
        try:
            assert read_embedded(short) is None  # cut between two fields
        except ConfigError as error:
            messages.append(str(error))
    assert len(messages) >= len(whole) - 10
    assert all("short.onnx" in message for message in messages)


@pytest.mark.parametrize("content", [b"", b"no model", b"\xff" * 100, b"\x72\xff\xff\xff\xff\x0f"])
def test_what_is_no_model_is_refused(content, embedded, tmp_path):
    model = tmp_path / "m.onnx"
    model.write_bytes(content)
    with pytest.raises(ConfigError, match=r"m\.onnx is not an ONNX model"):
        read_embedded(model)
    with pytest.raises(ConfigError, match=r"m\.onnx is not an ONNX model"):
        write_embedded(model, embedded)
    assert model.read_bytes() == content
    with pytest.raises(ConfigError, match="no model file"):
        read_embedded(tmp_path / "none.onnx")
