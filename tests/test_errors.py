"""The tree in the docstring of errors.py is the tree of the classes."""

import builtins
import inspect
import re

import pytest
from pydantic import BaseModel, ConfigDict, ValidationError

from hdmap_tools import errors
from hdmap_tools.errors import HDMapError

CLASSES = {
    name: cls
    for name, cls in vars(errors).items()
    if inspect.isclass(cls) and cls.__module__ == errors.__name__
}


def drawn_tree() -> dict[str, tuple[str, str | None]]:
    """Name -> (parent, built-in named in brackets), as the docstring draws it."""
    tree: dict[str, tuple[str, str | None]] = {}
    path: list[str] = []
    for line in inspect.getdoc(errors).splitlines():
        match = re.match(r"^    ([│├└─ ]*)(\w+Error)(?: \((\w+)\))?", line)
        if not match:
            continue
        depth = len(match[1]) // 4
        path = [*path[:depth], match[2]]
        tree[match[2]] = (path[depth - 1] if depth else "Exception", match[3])
    return tree


def test_the_drawing_is_read() -> None:
    tree = drawn_tree()
    assert tree["HDMapError"] == ("Exception", None)
    assert tree["PoseError"] == ("DriveError", None)
    assert tree["UnknownPluginError"] == ("PluginError", "LookupError")


def test_every_class_is_drawn_and_every_drawing_a_class() -> None:
    assert sorted(drawn_tree()) == sorted(CLASSES)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_bases_are_as_drawn(name: str) -> None:
    parent, builtin = drawn_tree()[name]
    expected = [parent] + ([builtin] if builtin else [])
    assert [base.__name__ for base in CLASSES[name].__bases__] == expected
    if builtin:
        assert hasattr(builtins, builtin)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_all_are_caught_by_the_root_and_keep_their_message(name: str) -> None:
    with pytest.raises(HDMapError, match="found 3, expected 4"):
        raise CLASSES[name]("found 3, expected 4")
    assert str(CLASSES[name]("found 3")) == "found 3"
    assert CLASSES[name].__doc__


def test_problems_of_a_document_are_few_short_and_on_one_line() -> None:
    class Document(BaseModel):
        model_config = ConfigDict(extra="forbid")
        first: int

    with pytest.raises(ValidationError) as caught:
        Document.model_validate({"first": "x" * 5000, "a\nb": 1, "c" * 5000: 2, "d": 3, "e": 4})
    text = errors.brief_problems(caught.value)
    assert text.startswith("first: Input should be a valid integer")
    assert text.endswith("and 2 more")
    assert text.isprintable()
    assert len(text) < 600
    assert "pydantic" not in text
