"""Hard cases I: image files that are damaged, hostile or missing. Each is one ImageError of one line that names the file."""

import io
import os
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import PIL.Image
import pytest

from jaxspring.images import ImageError, load_image


def refusal(path, **options):
    """The error message, after checking its form: one line that begins with the path."""
    with pytest.raises(ImageError) as caught:
        load_image(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def png(width, height, rows=0):
    """A PNG whose header claims `width` x `height` grey pixels and whose data hold `rows` rows."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    data = zlib.compress(bytes((width + 1) * rows))
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def npy_header(shape, descr="<f8"):
    """The first bytes of an `.npy` file that claims a shape and a type."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


@pytest.mark.parametrize("side", [20_000, 10_000])
def test_i5_large_png_is_refused_before_it_is_decoded(tmp_path, side):
    """20,000^2 and 10,000^2 pixels are refused by their header: little memory is taken, and the missing rows are not noticed."""
    path = tmp_path / "bomb.png"
    path.write_bytes(png(side, side))
    tracemalloc.start()
    try:
        message = refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()
    assert "pixels" in message
    assert str(side) in message or str(side**2) in message


def test_i5_the_limit_is_the_users(tmp_path):
    """A limit of one's own is obeyed on both sides."""
    path = tmp_path / "small.png"
    path.write_bytes(png(20, 10, rows=10))
    assert load_image(path, max_pixels=200).shape == (10, 20)
    assert "20 x 10 pixels exceed max_pixels = 199" in refusal(path, max_pixels=199)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.npy", "a.npz"])
def test_i1_truncated_anywhere(tmp_path, rng, name):
    """Cut at any length, a file is refused, or (cut in its trailer only) gives the very pixels."""
    path = tmp_path / name
    pixels = rng.integers(0, 256, (12, 9)).astype(np.uint8)
    if name == "a.npz":
        np.savez_compressed(path, pixels)
    elif name == "a.npy":
        np.save(path, pixels)
    else:
        PIL.Image.fromarray(pixels).save(path)
    whole, expected = path.read_bytes(), np.asarray(load_image(path).values)
    n_refused = 0
    for length in np.unique(np.linspace(0, len(whole) - 1, 60).astype(int)):
        path.write_bytes(whole[:length])
        try:
            values = load_image(path).values
        except ImageError as error:
            assert "\n" not in str(error)  # noqa: PT017 (most lengths raise, a few need not)
            n_refused += 1
        else:
            np.testing.assert_array_equal(values, expected)
    assert n_refused >= 40


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.npy", "a.npz"])
def test_i1_damaged_bytes_never_escape_as_another_error(tmp_path, rng, name):
    """With bytes of the header changed at random, the result is an image or an ImageError, nothing else."""
    path = tmp_path / name
    pixels = rng.integers(0, 256, (12, 9)).astype(np.uint8)
    if name == "a.npz":
        np.savez(path, pixels)
    elif name == "a.npy":
        np.save(path, pixels)
    else:
        PIL.Image.fromarray(pixels).save(path)
    whole = bytearray(path.read_bytes())
    for _ in range(150):
        damaged = whole.copy()
        damaged[rng.integers(8, min(len(whole), 160))] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            load_image(path, max_pixels=10_000)
        except ImageError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_i2_pickled_objects_are_refused_unrun(tmp_path):
    """An object array is refused, and what it would run on loading is not run."""
    marker = tmp_path / "ran"

    class Payload:
        def __reduce__(self):
            return os.mkdir, (str(marker),)

    bomb = np.array([[Payload()]], dtype=object)
    np.save(tmp_path / "a.npy", bomb, allow_pickle=True)
    np.savez(tmp_path / "a.npz", pixels=bomb)
    for name in ("a.npy", "a.npz"):
        assert "never unpickled" in refusal(tmp_path / name)
    assert not marker.exists()


@pytest.mark.parametrize("shape", [(10_000_000, 1_000_000), (8000, 8001), (2**40, 2**40)])
def test_i3_npy_headers_that_claim_too_much(tmp_path, shape):
    """A header of 80 TB is refused before anything is allocated, in a plain file and in an archive."""
    (tmp_path / "a.npy").write_bytes(npy_header(shape) + bytes(80))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("pixels.npy", npy_header(shape) + bytes(80))
    for name in ("a.npy", "a.npz"):
        assert "more than max_pixels" in refusal(tmp_path / name)


def test_i3_archive_that_unpacks_to_much(tmp_path):
    """A member of 256 MB packed into 250 kB is refused by its header, unread."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("pixels.npy", "w") as member:
        member.write(npy_header((16_000, 16_000), "|u1"))
        for _ in range(256):
            member.write(bytes(1_000_000))
    tracemalloc.start()
    try:
        assert "more than max_pixels" in refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


def test_i3_npy_that_is_shorter_than_it_claims(tmp_path):
    """A header within the limit, with 80 bytes after it where 400 MB should be: refused without taking 400 MB."""
    path = tmp_path / "a.npy"
    path.write_bytes(npy_header((7000, 7000)) + bytes(80))
    tracemalloc.start()
    try:
        assert "cut short" in refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.png", b"", "empty"),
        ("text.png", b"this is no picture", "not an image"),
        ("zip.npz", b"PK\x03\x04 and then nothing", "archive"),
        ("page.png", b"<html>404</html>", "not an image"),
        ("vector.eps", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "not an image"),
    ],
)
def test_files_that_are_no_image(tmp_path, name, content, message):
    """Empty files, text and formats that are not supported say so."""
    (tmp_path / name).write_bytes(content)
    assert message in refusal(tmp_path / name)


def test_paths_that_are_no_file(tmp_path):
    """A missing file, a directory and a device are refused (a device would never end)."""
    assert "No such file" in refusal(tmp_path / "missing.png")
    assert "not a file" in refusal(tmp_path)
    assert "not a file" in refusal("/dev/zero")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.ones((3, 4, 3)), "shape (3, 4, 3)"),
        (np.ones((0, 4)), "shape (0, 4)"),
        (np.ones(4), "shape (4,)"),
        (np.ones((2, 2), complex), "complex128"),
        (np.ones((2, 2), np.float16), "half precision"),
        (np.full((2, 2), "a"), "<U1"),
        (np.array([[1.0, np.inf]]), "values[0, 1] is inf"),
        (np.zeros((2, 2), [("a", "f8")]), "not real numbers"),
    ],
    ids=str,
)
def test_arrays_that_are_no_image(tmp_path, array, message):
    """Shape, type and values that `Image` refuses become the file's error."""
    np.save(tmp_path / "a.npy", array)
    assert message in refusal(tmp_path / "a.npy")
