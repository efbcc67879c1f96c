"""The built-in vectorizers, registered by the same entry points as anyone's."""
