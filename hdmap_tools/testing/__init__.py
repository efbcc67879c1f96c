"""Conformance tests and small scenes with known truth, for us and for plugin authors."""
