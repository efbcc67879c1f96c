"""What keeps S3 from being asked, told apart by the words of the libraries below."""

from __future__ import annotations

from typing import Final

_REFUSALS: Final = (
    "AccessDenied",
    "Forbidden",
    "InvalidAccessKeyId",
    "SignatureDoesNotMatch",
    "ExpiredToken",
    "InvalidToken",
)


def why_not_asked(text: str, cause: str, place: str, bucket: str, server: str) -> str | None:
    """One line on why S3 could not be asked, and what to do; None if it was asked.

    Args:
        text: All that the library said.
        cause: The deepest cause of it.
        place: What was asked for.
        bucket: Where that lies.
        server: The endpoint, or a name for the default one.
    """
    if "NoSuchBucket" in text:
        return f"There is no bucket {bucket!r} at {server}; make it, or correct {place}."
    # Before the credentials: what refuses them also names them.
    if refused := [code for code in _REFUSALS if code in text]:
        return (
            f"{server} refuses access to {place} ({refused[0]}); check the credentials and what they may "
            "do: list the bucket, get, put and delete objects."
        )
    if "credential" in text.lower():
        return (
            f"No credentials for {place} were found; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "AWS_PROFILE."
        )
    if is_outage(text):
        return (
            f"Nothing answers for {place} at {server} ({cause}); check AWS_ENDPOINT_URL, AWS_REGION and the "
            "network."
        )
    return None


def is_outage(text: str) -> bool:
    """Whether an object could not be had because of the connection, or of rights to it."""
    told = text.lower()
    return (
        "dispatch failure" in told
        or "timeout" in told
        or "credential" in told
        or any(code in text for code in _REFUSALS)
    )
