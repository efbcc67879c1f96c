"""An S3 server on the loopback address, for tests."""

import http.client
import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

CREDENTIALS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}
"""The server takes any."""

_SIGNED = {
    "Authorization": "AWS4-HMAC-SHA256 Credential=key/20260101/us-east-1/s3/aws4_request, "
    "SignedHeaders=host, Signature=none"
}
"""Without it the server takes a request for a stranger's; it does not check the signature."""


@dataclass(frozen=True)
class S3Server:
    """A running server with one bucket, ``maps``."""

    host: str
    port: int

    @property
    def url(self) -> str:
        return f"http://{self.host}:{self.port}"

    def keys(self, prefix: str) -> list[str]:
        """Names of the objects below a prefix."""
        listing = self.request("GET", f"/maps?list-type=2&prefix={prefix}/")
        return [key.removeprefix(f"{prefix}/") for key in re.findall("<Key>(.*?)</Key>", listing)]

    def request(self, method: str, path: str, body: bytes | None = None) -> str:
        connection = http.client.HTTPConnection(self.host, self.port, timeout=10)
        try:
            connection.request(method, path, body, _SIGNED)
            answer = connection.getresponse()
            text = answer.read().decode()
            assert answer.status in (200, 204), text
            return text
        finally:
            connection.close()

    @contextmanager
    def asking_for_rights(self) -> Iterator[None]:
        """From now on credentials are looked up, and nobody has any."""
        self.request("POST", "/moto-api/reset-auth", b"0")
        try:
            yield
        finally:
            self.request("POST", "/moto-api/reset-auth", b"inf")


def watch_writes_of_refs(
    monkeypatch: pytest.MonkeyPatch, told: Callable[[int], bool | None]
) -> None:
    """Be told each write or removal of a branch, numbered from 1, before it is done.

    Args:
        monkeypatch: Ends the watch.
        told: Gives True for a request that is to be lost.
    """
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication

    original, number = DomainDispatcherApplication.__call__, 0

    def watching(self: Any, environ: dict[str, Any], start_response: Any) -> Any:
        nonlocal number
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        is_removal = method == "POST" and environ["QUERY_STRING"].startswith("delete")
        if is_removal or (method == "PUT" and "/refs/" in path):
            number += 1
            if told(number):
                start_response("500 Lost", [("Content-Length", "0")])
                return []
        return original(self, environ, start_response)

    monkeypatch.setattr(DomainDispatcherApplication, "__call__", watching)


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """A server that ends with the block."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server.start()
    try:
        running = S3Server(*server.get_host_and_port())
        running.request("PUT", "/maps")
        yield running
    finally:
        server.stop()


def use(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the environment name the server, and nothing else."""
    for name in ("AWS_PROFILE", "AWS_ENDPOINT_URL_S3", "AWS_SESSION_TOKEN", "AWS_DEFAULT_REGION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_CONFIG_FILE", "/nonexistent")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
    monkeypatch.setenv("AWS_REGION", "eu-central-1")
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
