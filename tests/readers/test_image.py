"""Images: right pixels in, one clear line out for anything damaged."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.errors import ImageError
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import find_damage, read_image

CAMERA = PinholeCamera("cam", 96, 64, 80.0, 80.0, 47.5, 31.5, SE3.identity())


def noise_rgb() -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (64, 96, 3), dtype=np.uint8)


def encode(suffix: str, image: np.ndarray, *flags: int) -> bytes:
    ok, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), list(flags))
    assert ok
    return bytes(data)


BASELINE = encode(".jpg", noise_rgb())
PROGRESSIVE = encode(".jpg", noise_rgb(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTS = encode(".jpg", noise_rgb(), cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
PNG = encode(".png", noise_rgb())
FILES = {"baseline": BASELINE, "progressive": PROGRESSIVE, "restarts": RESTARTS, "png": PNG}


def ref_to(path: Path) -> ImageRef:
    return ImageRef("cam", 7, path)


def with_app1(jpeg: bytes, payload: bytes) -> bytes:
    return jpeg[:2] + b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload + jpeg[2:]


def test_pixels_come_back_in_rgb_order(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(PNG)
    image = read_image(ref_to(tmp_path / "a.png"), CAMERA)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, noise_rgb())


@pytest.mark.parametrize("name", ["baseline", "progressive", "restarts"])
def test_every_kind_of_jpeg_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(FILES[name] + b"\x00" * 13)  # cameras pad their files
    assert read_image(ref_to(tmp_path / "a.jpg"), CAMERA).shape == (64, 96, 3)


def test_fill_bytes_before_a_marker_are_allowed() -> None:
    assert find_damage(BASELINE[:2] + b"\xff\xff" + BASELINE[2:]) is None


def test_a_grey_image_becomes_three_equal_channels(tmp_path: Path) -> None:
    grey = noise_rgb()[:, :, 0]
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    image = read_image(ref_to(tmp_path / "a.png"), CAMERA)
    np.testing.assert_array_equal(image, np.repeat(grey[:, :, None], 3, axis=2))


def test_an_exif_rotation_is_ignored_as_calibration_is_of_the_stored_pixels(
    tmp_path: Path,
) -> None:
    # Exif, big endian, one entry: tag 0x0112 (orientation), type short, count 1, value 6.
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
    exif = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01" + entry + b"\x00\x00\x00\x00"
    rotated = with_app1(BASELINE, exif)
    assert cv2.imdecode(np.frombuffer(rotated, np.uint8), cv2.IMREAD_COLOR).shape == (96, 64, 3)
    (tmp_path / "a.jpg").write_bytes(rotated)
    assert read_image(ref_to(tmp_path / "a.jpg"), CAMERA).shape == (64, 96, 3)


@settings(deadline=None, max_examples=300)
@given(name=st.sampled_from(sorted(FILES)), share=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_is_never_taken_for_whole(name: str, share: float) -> None:
    data = FILES[name]
    assert find_damage(data) is None
    cut = data[: int(share * len(data))]
    # Within the first bytes the format is not yet recognizable: then it does not decode.
    if len(cut) < 8:
        assert find_damage(cut) or cv2.imdecode(np.frombuffer(cut, np.uint8), 1) is None
    else:
        assert "truncated" in str(find_damage(cut))


def test_a_truncated_jpeg_is_refused_where_opencv_returns_a_grey_one(tmp_path: Path) -> None:
    half = BASELINE[: len(BASELINE) // 2]
    (tmp_path / "a.jpg").write_bytes(half)
    grey = cv2.imread(str(tmp_path / "a.jpg"))
    assert grey is not None
    assert (grey[-8:] == 128).all()
    with pytest.raises(ImageError, match=r"a\.jpg is damaged: .* \(truncated\)\. Copy it again"):
        read_image(ref_to(tmp_path / "a.jpg"), CAMERA)


def test_the_end_marker_of_a_thumbnail_does_not_hide_a_truncation() -> None:
    # BASELINE inside APP1 ends with an end marker of its own.
    small = encode(".jpg", noise_rgb()[:8, :8])
    whole = with_app1(BASELINE, b"Exif\x00\x00" + small)
    assert find_damage(whole) is None
    assert "truncated" in str(find_damage(whole[: len(whole) - 200]))


def test_a_changed_byte_in_a_png_is_found_by_its_checksum() -> None:
    changed = bytearray(PNG)
    changed[len(PNG) // 2] ^= 0x10
    assert "fails its checksum" in str(find_damage(bytes(changed)))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"<html>404 not found</html>", "does not decode .* expected a JPEG or PNG"),
        (b"\xff\xd8\xff\xd9", "holds no pixels"),
        (b"\xff\xd8hello", "byte 2 is not a JPEG marker"),
        (b"\x89PNG\r\n\x1a\n", "truncated"),
    ],
)
def test_what_is_not_an_image_is_refused_in_one_line(
    content: bytes, message: str, tmp_path: Path
) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(ImageError, match=message) as caught:
        read_image(ref_to(tmp_path / "a.jpg"), CAMERA)
    assert "\n" not in str(caught.value)


def test_a_missing_image_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.jpg", tmp_path):
        with pytest.raises(ImageError, match="cannot be read"):
            read_image(ref_to(path), CAMERA)


def test_an_image_of_another_size_says_found_and_expected(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode(".png", noise_rgb()[:, :48]))
    with pytest.raises(ImageError, match=r"48x64 px, but camera cam is calibrated for 96x64 px"):
        read_image(ref_to(tmp_path / "a.png"), CAMERA)


def test_more_pixels_than_opencv_allows_are_refused(tmp_path: Path) -> None:
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", 2**20, 2**20, 8, 0, 0, 0, 0)
    bomb = (
        PNG[:8] + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")
    )
    (tmp_path / "a.png").write_bytes(bomb)
    with pytest.raises(ImageError, match="does not decode"):
        read_image(ref_to(tmp_path / "a.png"), CAMERA)
