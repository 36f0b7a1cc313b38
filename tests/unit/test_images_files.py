"""Loading images of every supported kind gives the pixels that were saved."""

import sys

import numpy as np
import PIL.Image
import pytest

from jaxspring.images import Channel, ImageError, Luminance, elevation_model, image_from_array, load_image


@pytest.fixture
def save(tmp_path):
    """Write an array by Pillow and return the path."""

    def write(pixels, name="image.png", mode=None, **options):
        path = tmp_path / name
        picture = PIL.Image.fromarray(pixels)
        if mode:
            picture = picture.convert(mode, palette=PIL.Image.Palette.ADAPTIVE)
        picture.save(path, **options)
        return path

    return write


@pytest.mark.parametrize(
    ("name", "dtype", "high"),
    [("a.png", "uint8", 256), ("a.png", "uint16", 65536), ("a.tif", "uint8", 256), ("a.tif", "uint16", 65536), ("a.png", "bool", 2)],
)
def test_whole_numbers_keep_their_range(save, rng, name, dtype, high):
    """8 and 16 bits and black-and-white come back as they were saved, as floating numbers, row 0 on top."""
    pixels = rng.integers(0, high, (5, 7)).astype(dtype)
    np.testing.assert_array_equal(load_image(save(pixels, name)).values, pixels.astype(float))


def test_floating_tiff(save, rng):
    """A float32 TIFF stays float32; NaN is refused, or filled on request."""
    pixels = rng.random((5, 7)).astype(np.float32)
    image = load_image(save(pixels, "a.tif"), spacing=2.0, origin=(1.0, 3.0))
    assert image.dtype == np.float32
    assert [float(s) for s in (*image.spacing, *image.origin)] == [2, 2, 1, 3]
    np.testing.assert_array_equal(image.values, pixels)
    pixels[2, 3] = np.nan
    with pytest.raises(ImageError, match=r"values\[2, 3\] is nan"):
        load_image(save(pixels, "a.tif"))
    assert load_image(save(pixels, "a.tif"), fill=-1.0).values[2, 3] == -1


def test_jpeg(save):
    """A smooth grey JPEG comes back within its coding error."""
    y, x = np.mgrid[:32, :40]
    pixels = (3 * x + 2 * y).astype(np.uint8)
    np.testing.assert_allclose(load_image(save(pixels, "a.jpg", quality=95)).values, pixels, atol=6)


@pytest.mark.parametrize(("mode", "n_channels"), [("RGB", 3), ("RGBA", 4), ("LA", 2), ("P", 3)])
def test_colour_is_refused_unless_told_how(save, rng, mode, n_channels):
    """Colour, opacity and palettes are errors that name the shape; Luminance and Channel make them grey."""
    pixels = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)
    pixels[...] = pixels[..., :1]  # grey, so that every way to grey gives the same
    path = save(pixels, mode=mode)
    with pytest.raises(ImageError, match=rf"shape \(5, 7, {n_channels}\)"):
        load_image(path)
    for channel in (Luminance(), Channel(0)):
        np.testing.assert_allclose(load_image(path, channel).values, pixels[..., 0], rtol=1e-12)


def test_luminance_weights_and_channels(rng):
    """0.299 R + 0.587 G + 0.114 B whatever the type; Channel takes one; a channel that is not there is named."""
    pixels = rng.integers(0, 256, (4, 5, 4)).astype(np.uint8)
    pixels[..., 3] = 255  # opaque
    expected = pixels[..., 0] * 0.299 + pixels[..., 1] * 0.587 + pixels[..., 2] * 0.114
    np.testing.assert_allclose(image_from_array(pixels, Luminance()).values, expected, rtol=1e-12)
    np.testing.assert_array_equal(image_from_array(pixels, Channel(2)).values, pixels[..., 2])
    with pytest.raises(ValueError, match=r"Channel\(4\) does not exist.*0 to 3"):
        image_from_array(pixels, Channel(4))


def test_a_grey_image_needs_no_channel(rng):
    """Asked for luminance, an image that is grey already is left as it is."""
    pixels = rng.random((4, 5))
    np.testing.assert_array_equal(image_from_array(pixels, Luminance()).values, pixels)


def test_photographs_are_turned_upright(save):
    """The EXIF orientation "rotated by 90 degrees" is undone."""
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(load_image(save(pixels, "a.png", exif=exif)).values, np.rot90(pixels, -1))


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i2", ">u2", "bool", "uint8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path, rng, dtype, order):
    """Every real type, byte order and memory order of `.npy` comes back exactly."""
    pixels = np.asarray(rng.integers(0, 2, (5, 7)).astype(dtype), order=order)
    np.save(tmp_path / "a.npy", pixels)
    np.testing.assert_array_equal(load_image(tmp_path / "a.npy").values, pixels.astype(float))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(tmp_path, rng, save):
    """The only array of an archive is taken; of several, the one named; else the names are listed."""
    pixels = rng.random((5, 7))
    save(tmp_path / "one.npz", pixels=pixels)
    save(tmp_path / "two.npz", height=pixels, other=np.ones(3))
    np.testing.assert_array_equal(load_image(tmp_path / "one.npz").values, pixels)
    np.testing.assert_array_equal(load_image(tmp_path / "two.npz", array="height").values, pixels)
    for name in (None, "heights"):
        with pytest.raises(ImageError, match="it holds height, other"):
            load_image(tmp_path / "two.npz", array=name)


def test_the_kind_is_read_from_the_file_not_its_name(tmp_path, rng):
    """A `.npy` file called `.png` is loaded as what it is."""
    pixels = rng.random((3, 4))
    with open(tmp_path / "a.png", "wb") as stream:
        np.save(stream, pixels)
    np.testing.assert_array_equal(load_image(tmp_path / "a.png").values, pixels)


def test_elevation_model():
    """The built-in data: 344 x 403 heights from 236 m to 1076 m, as in matplotlib's file."""
    image = elevation_model()
    assert image.shape == (344, 403)
    assert (image.values.min(), image.values.max()) == (236, 1076)
    assert float(elevation_model(spacing=(74.0, 93.0)).spacing[1]) == 93


def test_missing_extras_say_what_to_install(monkeypatch, save):
    """Without Pillow or matplotlib the ImportError names the extra."""
    path = save(np.ones((3, 3), np.uint8))
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(ImportError, match=r"pip install jaxspring\[viz\]"):
        load_image(path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install jaxspring\[viz\]"):
        elevation_model()
