"""Every vectorizer that is installed here keeps what the contract promises."""

import pytest

from hdmap_tools import registry
from hdmap_tools.registry import PluginState
from hdmap_tools.testing.conformance import (
    ADVISORY_CHECKS,
    REQUIRED_CHECKS,
    Case,
    Check,
)

OURS = "hdmap-tools"


def installed() -> list[str]:
    """Names that can be loaded; a foreign plugin that is broken is not ours to fail for."""
    return sorted(
        {
            entry.name
            for entry in registry.discover()
            if registry.status(entry.name).state is PluginState.OK
        }
    )


@pytest.mark.parametrize(
    "name", sorted(e.name for e in registry.discover() if e.distribution == OURS)
)
def test_what_we_register_can_be_loaded(name: str) -> None:
    assert registry.status(name).reason == ""
    assert registry.status(name).state is PluginState.OK


@pytest.mark.parametrize("check", REQUIRED_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", installed())
def test_required(name: str, check: Check) -> None:
    check(Case(registry.load(name)))


@pytest.mark.parametrize("check", ADVISORY_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize(
    "name",
    [e.name for e in registry.discover() if e.distribution == OURS and e.name in installed()],
)
def test_ours_keep_the_advisory_ones_too(name: str, check: Check) -> None:
    check(Case(registry.load(name)))
