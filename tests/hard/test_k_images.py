"""Hard cases K, images: whatever a file stores comes as stored, or as one ImageError that says what was found and what to do."""

import io
import struct
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
import tifffile

import jaxspring as js
from jaxspring.forces.adaptive import ImageStiffness
from jaxspring.images import (
    Channel,
    Combined,
    Curvature,
    GradientMagnitude,
    Image,
    ImageError,
    Luminance,
    adaptation,
    gradient_magnitude,
    image_from_array,
    load_image,
    principal_curvatures,
)

WHOLE = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8"]


@pytest.fixture
def path(tmp_path):
    """Where the one file of a test goes."""
    return tmp_path / "file"


def numbers(rng, dtype, shape=(6, 7)):
    """Numbers over the whole range of a type, its ends included."""
    if dtype[0] == "f":
        return rng.normal(size=shape).astype(dtype) * 1000
    low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    drawn = rng.integers(low, high, shape, dtype, endpoint=True)
    drawn.flat[:2] = low, high
    return drawn


def refusal(path, *given, **options):
    """The one line of the error, less the path that it begins with."""
    with pytest.raises(ImageError) as caught:
        load_image(path, *given, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{path}: ")


def expect(path, right, *given, **options):
    """The image in the file has these values."""
    np.testing.assert_array_equal(load_image(path, *given, **options).values, np.asarray(right, float))


# TIFF


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", [*WHOLE, "f4", "f8"])
def test_tiff_of_every_type_and_byte_order(path, rng, dtype, order):
    """8 to 64 bits, signed and unsigned, float and double, either byte order: the numbers that were written."""
    right = numbers(rng, dtype)
    tifffile.imwrite(path, right, photometric="minisblack", byteorder=order)
    expect(path, right)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "zlib", "predictor": True},
        {"compression": "zlib", "predictor": True, "byteorder": ">", "tile": (16, 16)},
        {"compression": "lzma", "rowsperstrip": 3},
        {"tile": (32, 16), "bigtiff": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
def test_tiff_compressed_tiled_and_big(path, rng, dtype, options):
    """Strips, tiles, predictors and BigTIFF change nothing."""
    right = numbers(rng, dtype, (37, 45))
    tifffile.imwrite(path, right, photometric="minisblack", **options)
    expect(path, right)


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate"])
@pytest.mark.parametrize("dtype", ["?", "u1", "u2", "i4", "f4"])
def test_tiff_written_by_pillow(path, rng, dtype, compression):
    """LZW, which tifffile leaves to others, and two that it does not."""
    right = rng.integers(0, 2, (9, 11)).astype(bool) if dtype == "?" else numbers(rng, dtype, (9, 11))
    PIL.Image.fromarray(right).save(path, "TIFF", compression=compression)
    expect(path, right)


def test_tiff_unsigned_32_bits_in_lzw(path):
    """Above 2^31 the number does not wrap, though Pillow knows no such type."""
    right = np.array([[0, 3_000_000_000], [7, 2**32 - 1]], np.uint32)
    PIL.Image.fromarray(right.view(np.int32)).save(path, "TIFF", compression="tiff_lzw")
    bits = bytearray(path.read_bytes())
    place = bits.index(struct.pack("<HHI", 339, 3, 1))  # SampleFormat, one short
    bits[place + 8 : place + 10] = struct.pack("<H", 1)  # unsigned
    path.write_bytes(bits)
    expect(path, right)


@pytest.mark.parametrize("planes", ["contig", "separate"])
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8"])
def test_tiff_colours_keep_their_bits(path, rng, dtype, planes):
    """16-bit and floating colours are not cut to 8 bits; planes one after the other are the same picture."""
    right = numbers(rng, dtype, (6, 7, 3))
    tifffile.imwrite(path, right if planes == "contig" else np.moveaxis(right, -1, 0), photometric="rgb", planarconfig=planes)
    expect(path, right[..., 1], Channel(1))
    grey = right.astype(float) @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(load_image(path, Luminance()).values, grey, rtol=1e-5, atol=1e-2)


def test_tiff_bands_are_no_colours(path, rng):
    """Seven bands of a satellite: one is chosen by its number; a mean of three by weights of colours is refused."""
    right = numbers(rng, "u2", (6, 7, 7))
    tifffile.imwrite(path, right, photometric="minisblack", planarconfig="contig")
    expect(path, right[..., 6], Channel(6))
    tifffile.imwrite(path, right[..., :2], photometric="minisblack", planarconfig="contig")
    assert "2 bands that are no colours" in refusal(path, Luminance())
    assert "(6, 7, 2)" in refusal(path)


@pytest.mark.parametrize("dtype", ["?", "u1", "u2", "u4"])
def test_tiff_where_zero_is_white(path, rng, dtype):
    """Brightness is read, at every number of bits; 255 - x, 65535 - x and so on."""
    dark = rng.integers(0, 2, (6, 7)).astype(bool) if dtype == "?" else numbers(rng, dtype)
    tifffile.imwrite(path, dark, photometric="miniswhite")
    expect(path, ~dark)


def test_tiff_where_zero_is_white_without_a_blackest(path):
    """Signed and floating numbers have no end to count from: refused."""
    for dtype in ("i2", "f4"):
        tifffile.imwrite(path, np.ones((3, 4), dtype), photometric="miniswhite")
        assert "zero is white" in refusal(path)


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_tiff_where_zero_is_white_through_either_reader(path, rng, compression):
    """The picture that Pillow shows, whichever package decodes it."""
    pixels = numbers(rng, "u1")
    PIL.Image.fromarray(pixels).save(path, "TIFF", compression=compression, tiffinfo={262: 0})
    expect(path, np.asarray(PIL.Image.open(path)))


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw"])
def test_tiff_palette(path, rng, compression):
    """The colours that Pillow shows."""
    picture = PIL.Image.fromarray(rng.integers(0, 256, (6, 7, 3)).astype(np.uint8)).convert("P", palette=PIL.Image.Palette.ADAPTIVE)
    picture.save(path, "TIFF", compression=compression)
    for i in range(3):
        expect(path, np.asarray(picture.convert("RGB"))[..., i], Channel(i))


@pytest.mark.parametrize("bits", [2, 4])
def test_tiff_of_few_bits(path, rng, bits):
    """2 and 4 bits come as stored, 0 to 3 and 0 to 15, not spread over 255."""
    right = rng.integers(0, 2**bits, (6, 8)).astype(np.uint8)
    packed = np.packbits(np.unpackbits(right[..., None], axis=-1)[..., 8 - bits :].reshape(6, -1), axis=-1)
    tags = [
        (256, 3, 8),
        (257, 3, 6),
        (258, 3, bits),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
        (277, 3, 1),
        (278, 3, 6),
        (279, 4, packed.size),
    ]
    offset = 8 + packed.size
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    path.write_bytes(b"II*\0" + struct.pack("<I", offset) + packed.tobytes() + struct.pack("<H", len(tags)) + entries + bytes(4))
    expect(path, right)


def test_tiff_pages(path, rng):
    """Of several pages none is taken by chance; of a page with smaller copies, the page."""
    stack = numbers(rng, "u2", (3, 6, 7))
    tifffile.imwrite(path, stack, photometric="minisblack")
    assert "3 pages; pass page=<0 to 2>" in refusal(path)
    for i in (0, 2, -1):
        expect(path, stack[i], page=i)
    assert "no page 3" in refusal(path, page=3)
    with tifffile.TiffWriter(path) as writer:
        writer.write(stack[0], photometric="minisblack")
        writer.write(stack[0, ::2, ::2], photometric="minisblack", subfiletype=1)
    expect(path, stack[0])


def test_tiff_volumes_and_cut_files_are_refused(path, rng):
    """A volume in one page is no plane; strips beyond the end of the file are not zeros."""
    tifffile.imwrite(path, numbers(rng, "u1", (16, 32, 32)), photometric="minisblack", volumetric=True, tile=(16, 16, 16))
    assert "save one plane" in refusal(path)
    for options in ({"rowsperstrip": 8, "compression": "zlib"}, {"tile": (16, 16)}, {"rowsperstrip": 64}):
        tifffile.imwrite(path, np.ones((64, 64), np.float32), photometric="minisblack", **options)
        path.write_bytes(path.read_bytes()[:-40])
        assert "cut short" in refusal(path)


def test_tiff_that_would_be_cut_to_8_bits_is_refused(path, rng):
    """Where only Pillow could decode it and would lose bits, the line says what it is and what to save instead."""
    tifffile.imwrite(path, numbers(rng, "u2", (6, 7, 3)), photometric="rgb")
    data = bytearray(path.read_bytes())
    place = data.index(struct.pack("<HHI", 259, 3, 1))
    data[place + 8 : place + 10] = struct.pack("<H", 5)  # claims LZW
    path.write_bytes(data)
    message = refusal(path, Luminance())
    assert "3 x 16 bits, RGB, compression LZW" in message or "damaged" in message  # the latter where imagecodecs is installed
    assert "save" in message or "write" in message


# Pixels without a value


@pytest.mark.parametrize(
    ("dtype", "hole", "text"),
    [
        ("f4", -9999, "-9999"),
        ("f8", -9999, "-9999.0"),
        ("f4", -3.4028234663852886e38, "-3.40282e+38"),
        ("f4", -3.4028234663852886e38, "-3.4028234663852886e+38"),
        ("f4", np.nan, "nan"),
        ("i2", -32768, "-32768"),
        ("u2", 65535, "65535 "),
        ("u1", 0, "0"),
        ("f4", 0.1, "0.1"),
        ("u8", 2**64 - 1, "18446744073709551615"),
    ],
)
def test_declared_nodata_is_no_height(path, dtype, hole, text):
    """GDAL's tag is heeded in every type, as text that was rounded too: refused by place and number, or filled."""
    heights = (100 + 10 * np.arange(12).reshape(3, 4)).astype(dtype)
    heights[1, 1] = heights[2, 3] = hole
    tifffile.imwrite(path, heights, photometric="minisblack", extratags=[(42113, "s", 0, text, True)])
    message = refusal(path)
    if not np.isnan(hole):
        assert "[1, 1]" in message
        assert "2 of 12" in message
        assert "no-data" in message
    right = np.where(np.isin(np.arange(12).reshape(3, 4), [5, 11]), 7.5, 100 + 10 * np.arange(12).reshape(3, 4))
    expect(path, right, fill=7.5)


@pytest.mark.parametrize("text", ["-1", "0.5", "1e30", "nan", "70000"])
def test_nodata_that_the_type_cannot_hold_is_nowhere(path, text):
    """-1 for unsigned numbers, as many files declare it, hides nothing."""
    right = np.array([[0, 65535], [1, 2]], np.uint16)
    tifffile.imwrite(path, right, photometric="minisblack", extratags=[(42113, "s", 0, text, True)])
    expect(path, right)


def test_nodata_of_colours(path):
    """The triple is no-data, not one of its colours: a blue without red stays; a chosen channel is asked for itself."""
    pixels = np.array([[[0, 0, 0], [0, 50, 20]]], np.uint8)
    tifffile.imwrite(path, pixels, photometric="rgb", extratags=[(42113, "s", 0, "0", True)])
    np.testing.assert_allclose(load_image(path, Luminance(), fill=9.0).values, [[9, 50 * 0.587 + 20 * 0.114]])
    expect(path, [[9, 9]], Channel(0), fill=9.0)


def test_nodata_that_is_no_number(path):
    """Unreadable text is refused, not ignored."""
    tifffile.imwrite(path, np.ones((3, 4), np.float32), extratags=[(42113, "s", 0, "none", True)])
    assert "'none', which is no number" in refusal(path)


def test_a_mask_page_is_heeded(path):
    """GDAL's internal mask hides pixels: refused, or filled."""
    with tifffile.TiffWriter(path) as writer:
        writer.write(np.arange(12, dtype=np.float32).reshape(3, 4), photometric="minisblack")
        writer.write(np.arange(12).reshape(3, 4) != 5, photometric=4, subfiletype=4)
    assert "pixel [1, 1] is masked" in refusal(path)
    expect(path, np.where(np.arange(12) == 5, -1, np.arange(12)).reshape(3, 4), fill=-1.0)


def test_masked_arrays():
    """What lies under a mask is never read: refused by place, or filled; an empty mask is no matter."""
    masked = np.ma.masked_equal(np.array([[1.0, 2.0], [-9999.0, 4.0]]), -9999)
    for build in (Image, image_from_array):
        with pytest.raises(ValueError, match=r"\[1, 0\] is masked"):
            build(masked)
        np.testing.assert_array_equal(build(np.ma.array([[1.0, 2.0]])).values, [[1, 2]])
    np.testing.assert_array_equal(image_from_array(masked, fill=0.0).values, [[1, 2], [0, 4]])
    colours = np.ma.array(np.full((1, 2, 3), 10.0), mask=[[[0, 1, 0], [0, 0, 0]]])
    np.testing.assert_allclose(image_from_array(colours, Luminance(), fill=1.0).values, [[1, 10]])
    np.testing.assert_array_equal(image_from_array(colours, Channel(0)).values, [[10, 10]])
    with pytest.raises(ValueError, match="fill = nan"):
        image_from_array(masked, fill=np.nan)


@pytest.mark.parametrize("mode", ["LA", "RGBA"])
@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_transparent_pixels_need_a_background(path, rng, mode, kind):
    """Opaque pixels are themselves; a transparent one is `fill`, a half transparent one is mixed with it, and without `fill` refused."""
    grey = rng.integers(1, 255, (4, 5)).astype(np.uint8)
    opacity = np.full((4, 5), 255, np.uint8)
    colours = [grey] * (len(mode) - 1)
    PIL.Image.fromarray(np.stack([*colours, opacity], -1)).save(path, kind)
    np.testing.assert_allclose(load_image(path, Luminance()).values, grey)
    opacity[1, 2], opacity[3, 4] = 0, 51
    PIL.Image.fromarray(np.stack([*colours, opacity], -1)).save(path, kind)
    message = refusal(path, Luminance())
    assert "pixel [1, 2] is transparent" in message
    assert "2 of 20" in message
    right = grey.astype(float)
    right[1, 2], right[3, 4] = 30, 0.2 * grey[3, 4] + 0.8 * 30
    for channel in (Luminance(), Channel(0)):
        np.testing.assert_allclose(load_image(path, channel, fill=30.0).values, right)
    expect(path, opacity, Channel(-1))


def test_colours_stored_times_their_opacity(path):
    """Premultiplied colours are not multiplied again."""
    tifffile.imwrite(path, np.array([[[100, 100, 100, 128], [7, 7, 7, 255]]], np.uint8), photometric="rgb", extrasamples="assocalpha")
    np.testing.assert_allclose(load_image(path, Channel(0), fill=255.0).values, [[100 + 255 * 127 / 255, 7]])


# PNG and JPEG


def png(bits, colour, rows, *chunks):
    """A PNG from packed rows, with further chunks before the pixels."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, data = rows.shape[0], rows.shape[1], rows
    if bits < 8:
        data = np.packbits(np.unpackbits(rows[..., None], axis=-1)[..., 8 - bits :].reshape(height, -1), axis=-1)
    lines = b"".join(b"\0" + row.astype(">u2" if bits == 16 else "u1").tobytes() for row in data)
    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    parts = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(lines)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_png_grey_of_every_depth_comes_as_stored(path, rng, bits):
    """0 to 2^bits - 1, whatever gamma the file tells; one grey declared as transparent is no value."""
    right = rng.integers(0, 2**bits, (5, 8)).astype(np.uint16 if bits == 16 else np.uint8)
    path.write_bytes(png(bits, 0, right, (b"gAMA", struct.pack(">I", 100_000))))
    expect(path, right)
    path.write_bytes(png(bits, 0, right, (b"tRNS", struct.pack(">H", int(right[2, 3])))))
    assert "is masked" in refusal(path)
    expect(path, np.where(right == right[2, 3], 0.5, right), fill=0.5)


@pytest.mark.parametrize(("colour", "n"), [(2, 3), (4, 2), (6, 4)])
def test_png_colours_of_16_bits_are_refused(path, rng, colour, n):
    """Pillow would keep 8 of the 16 bits: the line says so, and what to do."""
    path.write_bytes(png(16, colour, rng.integers(0, 2**16, (4, 5, n)).astype(np.uint16)))
    message = refusal(path, Luminance())
    assert "several channels of 16 bits" in message
    assert "save it as TIFF" in message


def test_png_palette_and_colour_with_transparency(path):
    """A transparent entry of a palette and a transparent colour are no value; the others are their colours."""
    table = bytes([10, 20, 30, 200, 100, 50])
    path.write_bytes(png(1, 3, np.array([[0, 1, 0, 1, 0, 0, 0, 1]], np.uint8), (b"PLTE", table), (b"tRNS", b"\x00")))
    assert "5 of 8 pixels" in refusal(path, Luminance())
    expect(path, [[-1, 200, -1, 200, -1, -1, -1, 200]], Channel(0), fill=-1.0)
    path.write_bytes(png(8, 2, np.array([[[1, 2, 3], [4, 5, 6]]], np.uint8), (b"tRNS", struct.pack(">HHH", 1, 2, 3))))
    assert "pixel [0, 0] is transparent" in refusal(path, Luminance())
    expect(path, [[0, 6]], Channel(2), fill=0.0)


def test_png_frames(path):
    """An animated PNG asks which frame; so many times as the frames are, not the first by chance."""
    frames = [PIL.Image.fromarray(np.full((3, 4), level, np.uint8)) for level in (10, 90)]
    frames[0].save(path, "PNG", save_all=True, append_images=frames[1:])
    assert "animated, with 2 frames" in refusal(path)
    expect(path, np.full((3, 4), 90), page=1)


def test_jpeg_of_inks(path):
    """CMYK becomes RGB as Pillow has it: no ink is white, full black is black."""
    inks = np.zeros((16, 16, 4), np.uint8)
    inks[:, 8:, 3] = 255
    PIL.Image.fromarray(inks, "CMYK").save(path, "JPEG", quality=100, subsampling=0)
    values = load_image(path, Luminance()).values
    np.testing.assert_allclose(values[:, :8], 255, atol=2)
    np.testing.assert_allclose(values[:, 8:], 0, atol=2)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF", "LZW"])
def test_pictures_are_turned_upright(path, kind, orientation):
    """All eight orientations, in every format: the turn that the EXIF standard asks for."""
    turns = [None, "FLIP_LEFT_RIGHT", "ROTATE_180", "FLIP_TOP_BOTTOM", "TRANSPOSE", "ROTATE_270", "TRANSVERSE", "ROTATE_90"]
    picture = PIL.Image.fromarray(np.kron(np.arange(6, dtype=np.uint8).reshape(2, 3) * 40, np.ones((8, 8), np.uint8)))
    options = {"JPEG": {"quality": 100}, "LZW": {"compression": "tiff_lzw"}}.get(kind, {})
    exif = PIL.Image.Exif()
    exif[0x0112] = orientation
    picture.save(path, "TIFF" if kind == "LZW" else kind, exif=exif, **options)
    turn = turns[orientation - 1]
    right = np.asarray(picture if turn is None else picture.transpose(PIL.Image.Transpose[turn]), float)
    np.testing.assert_allclose(load_image(path).values, right, atol=2 if kind == "JPEG" else 0)


def test_damaged_tiffs_of_many_kinds(path, rng):
    """With bytes of the tags changed at random, a TIFF is an image or an ImageError of one line, and takes little memory."""
    streams = []
    for options in ({"photometric": "minisblack", "compression": "zlib", "tile": (16, 16)}, {"photometric": "miniswhite"}):
        streams.append(io.BytesIO())
        tifffile.imwrite(streams[-1], numbers(rng, "u2", (20, 20)), extratags=[(42113, "s", 0, "-9999", True)], **options)
    for stream in streams:
        whole = bytearray(stream.getvalue())
        for _ in range(150):
            damaged = whole.copy()
            damaged[rng.integers(4, min(len(whole), 400))] = rng.integers(0, 256)
            path.write_bytes(damaged)
            try:
                load_image(path, max_pixels=10_000, fill=0.0)
            except ImageError as error:
                assert "\n" not in str(error)  # noqa: PT017


# Arrays of the caller


def test_an_image_keeps_what_it_was_given():
    """K1: arrays that are changed in place afterwards do not change the image, its spacing or its copies."""
    arrays = [np.ones((64, 64), np.float32) for _ in range(6)]
    images = [Image(arrays[0]), image_from_array(arrays[1]), *(Image(np.zeros((64, 64), np.float32)).with_values(a) for a in arrays[2:])]
    spacing = np.array([2.0, 3.0])
    images.append(Image(np.ones((4, 4)), spacing, spacing))
    for array in (*arrays, spacing):
        array[:] = 9
    assert all((image.values == 1).all() for image in images)
    assert [float(s) for s in (*images[-1].spacing, *images[-1].origin)] == [2, 3, 2, 3]


# Sizes of numbers


@jax.jit
@jax.grad
def _slopes(values):
    return jnp.sum(jnp.square(adaptation(Image(values), 0.0, radius=1).values))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1e-5, 1e5, 1e20, 1e30])
def test_k9_adaptation_does_not_depend_on_the_unit(scale, rng):
    """In float32 an image times 1e-30 to 1e30 gives the same adaptation, so the same springs; a constant image gives none."""
    pixels = rng.random((12, 10)).astype(np.float32)
    right = adaptation(Image(pixels), 1.0).values
    assert right.max() == 1
    image = Image((pixels * scale).astype(np.float32))
    np.testing.assert_allclose(adaptation(image, 1.0).values, right, atol=2e-5)
    np.testing.assert_allclose(image.normalised().values, Image(pixels).normalised().values, atol=1e-5)
    np.testing.assert_array_equal(adaptation(Image(np.full((5, 5), scale, np.float32)), 1.0).values, 0)
    rule = ImageStiffness(image, 1.0, 10.0, 1.0)
    np.testing.assert_allclose(rule.adaptation().values, right, atol=2e-5)
    np.testing.assert_allclose(_slopes(image.values) * scale, _slopes(Image(pixels).values), atol=1e-3)


@jax.jit
@jax.grad
def _steepness(values):
    return jnp.sum(gradient_magnitude(Image(values)))


@jax.jit
@jax.grad
def _curvedness(values):
    return jnp.sum(principal_curvatures(Image(values))[0])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1.0, 1e20, 1e30])
def test_k9_observations_against_float64(scale, rng):
    """Gradient magnitude and both curvatures in float32, for heights of 1e-30 to 1e30, are those in float64."""
    pixels = (rng.random((9, 9)) * scale).astype(np.float32)
    small, exact = Image(pixels), Image(pixels.astype(np.float64))
    np.testing.assert_allclose(gradient_magnitude(small), gradient_magnitude(exact), rtol=1e-5)
    for found, right in zip(principal_curvatures(small), principal_curvatures(exact), strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-4, atol=2e-6 * float(np.abs(right).max()))
    for find in (_steepness, _curvedness):
        right = find(exact.values)
        np.testing.assert_allclose(find(small.values), right, rtol=1e-4, atol=1e-4 * float(np.abs(right).max()))
    seen = adaptation(small, 1.0, Combined((GradientMagnitude(), Curvature()), (1.0, 1.0))).values
    assert 0 <= seen.min() <= seen.max() == 1


def test_k9_the_whole_range_of_float32():
    """From the lowest to the highest number the range overflows: it is halved first, not called infinite and everything 0."""
    image = Image(np.array([[-3e38, 0.0], [3e38, 3e38]], np.float32))
    np.testing.assert_allclose(image.normalised().values, [[0, 0.5], [1, 1]])


# Spacing that cannot be looked at


@pytest.mark.slow
def test_a_traced_spacing_of_zero_is_no_place():
    """Traced, a spacing of 0 gives NaN instead of a border pixel, and a run over such an image ends with INVALID."""
    pixels = np.arange(12.0).reshape(3, 4)
    read = jax.jit(lambda spacing: Image(pixels, spacing).sample_with_gradient(1.0, 2.0))
    assert all(np.isnan(part) for part in read(0.0))
    assert read(1.0)[0] == 9
    net = js.Graph.from_edges([[0, 1]], 2)
    start = js.State.from_points(net, [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])

    @jax.jit
    def run(spacing):
        image = Image(pixels, spacing)
        rule = js.Springs(net, ImageStiffness(image, 1.0, 2.0, 0.0, radius=0), 1.0)
        effects = (js.DataSprings(image, 1.0), js.ImageAttraction(image, 1.0), rule)
        return [js.rollout(js.System(net, 1.0, (effect,)), start, js.SymplecticEuler(), 0.01, 1).status for effect in effects]

    assert all(bool(status.has(js.Flag.INVALID)) for status in run(0.0))
    assert all(bool(status.is_ok) for status in run(1.0))
