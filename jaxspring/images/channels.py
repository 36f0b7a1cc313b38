"""From the pixels of a file to one channel: which channel, or what its colours encode, and what stands where a pixel has no value.

A pixel has no value where a mask or a declared no-data number says so, and where it is transparent. Such pixels are filled, made holes or
refused, never read: what a file stores under them is arbitrary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from .holes import Holes

# Up to so many channels a last axis is taken for colours and opacity; beyond, only `Channel` says what is meant.
MAX_COLOURS = 4
# The lowest float32 is the usual no-data number, and writers round it in their text. No height is near it.
_BEYOND = 3.4e38


class Channel(eqx.Module):
    """Take one channel of a colour image by its index.

    Attributes:
        index: 0, 1, 2 are red, green, blue; of two channels, 0 is grey and 1 is opacity (static).
    """

    index: int = eqx.field(static=True)

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, n_channels)` to `(ny, nx)`."""
        n_channels = pixels.shape[-1]
        if not -n_channels <= self.index < n_channels:
            raise ValueError(f"Channel({self.index}) does not exist: shape {pixels.shape} has channels 0 to {n_channels - 1}.")
        return pixels[..., self.index]


class Luminance(eqx.Module):
    """Grey from colour by the weights 0.299, 0.587, 0.114 of red, green, blue (ITU-R BT.601, on the stored values)."""

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, n_channels)` to `(ny, nx)`, in the range of the channels."""
        if pixels.shape[-1] < 3:
            return pixels[..., 0]
        dtype = pixels.dtype if pixels.dtype.kind == "f" else np.dtype(np.float64)
        red, green, blue = np.moveaxis(pixels[..., :3].astype(dtype), -1, 0)
        # From red on: where all three are one number, that very number.
        return red + dtype.type(0.587) * (green - red) + dtype.type(0.114) * (blue - red)


class TerrainRGB(eqx.Module):
    """Heights [m] from the colours of a terrain tile, h = -10000 + 0.1 (65536 R + 256 G + B): Mapbox's Terrain-RGB, to 0.1 m.

    >>> print(TerrainRGB()(np.array([[[1, 134, 160]]], np.uint8)))
    [[0.]]
    """

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, 3)` bytes, or with opacity behind them, to `(ny, nx)` [m]."""
        red, green, blue = _bytes(pixels, "TerrainRGB()")
        return (65536 * red + 256 * green + blue - 100_000) / 10


class Terrarium(eqx.Module):
    """Heights [m] from the colours of a terrain tile, h = 256 R + G + B / 256 - 32768: the Terrarium encoding, to 1/256 m.

    >>> print(Terrarium()(np.array([[[128, 1, 128]]], np.uint8)))
    [[1.5]]
    """

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, 3)` bytes, or with opacity behind them, to `(ny, nx)` [m]."""
        red, green, blue = _bytes(pixels, "Terrarium()")
        return 256 * red + green + blue / 256 - 32768


# How one number per pixel is had from several channels.
OneChannel = Channel | Luminance | TerrainRGB | Terrarium


def _bytes(pixels: NDArray[Any], name: str) -> NDArray[Any]:
    """Red, green, blue, each `(ny, nx)` whole numbers in float64."""
    if pixels.dtype != np.uint8 or pixels.shape[-1] < 3:
        raise ValueError(
            f"{name} reads heights from three channels of 8 bits, but the pixels are {pixels.dtype} of shape {pixels.shape}; pass the "
            "tile as it was served, or leave the channel out."
        )
    return np.moveaxis(pixels[..., :3].astype(np.float64), -1, 0)


@dataclass(frozen=True)
class Pixels:
    """What a file holds, as stored.

    Attributes:
        values: `(ny, nx)` or `(ny, nx, n_channels)`.
        nodata: the number that stands for "no value", as declared.
        mask: True where there is no value, of the shape of `values` or `(ny, nx)`.
        alpha: index of the channel of opacity.
        is_premultiplied: whether the colours are stored times their opacity.
        has_bands: whether the channels are bands of no told colour, so that they do not mix to grey.
    """

    values: NDArray[Any]
    nodata: float | None = None
    mask: NDArray[Any] | None = None
    alpha: int | None = None
    is_premultiplied: bool = False
    has_bands: bool = False

    @staticmethod
    def of_array(values: NDArray[Any], mask: NDArray[Any] | None = None) -> Pixels:
        """Of an array that says nothing of itself: bytes of two or four channels have their opacity in the last, as in a file."""
        has_opacity = values.ndim == 3 and values.shape[-1] in (2, 4) and values.dtype == np.uint8
        return Pixels(values, mask=mask, alpha=values.shape[-1] - 1 if has_opacity else None)

    def one_channel(self, channel: OneChannel | None, fill: float | None) -> NDArray[Any]:
        """`(ny, nx)`, with `fill` in place and behind; unchanged where no channel was asked for and there are several.

        Raises:
            ValueError: pixels without a value, or transparent ones, and no `fill`.
        """
        if fill is not None and not np.isfinite(fill):
            raise ValueError(f"fill = {fill}, but what takes the place of a pixel must be finite. Pass a number.")
        values = self._chosen(channel)
        if values.ndim == 3:
            return values
        missing = self._missing(channel)
        values = self._on_background(values, channel, fill)
        if missing is not None and missing.any():
            parts = [] if self.mask is None else ["is masked"]
            parts += [] if self.nodata is None else [f"holds the declared no-data value {self.nodata}"]
            reason = " or ".join(parts)
            values = np.where(missing, _wanted(fill, missing, reason), values)
        if fill is not None and values.dtype.kind == "f":
            values = np.where(np.isfinite(values), values, np.asarray(fill, values.dtype))
        return values

    def weighted(self, channel: OneChannel | None, holes: Holes) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """`(ny, nx)` values and weights: 0 in a hole, the opacity where there is one, else 1. Several channels stay, without weights.

        Raises:
            ValueError: colours that are stored times their opacity.
        """
        values = self._chosen(channel)
        if values.ndim == 3:
            return values, None
        weights = np.ones(values.shape)
        if (opacity := self._opacity(channel)) is not None:
            if self.is_premultiplied and ((opacity > 0) & (opacity < 1)).any():
                raise ValueError(
                    "its colours are stored times their opacity, so that they are no values; pass fill=, or save them plainly."
                )
            weights = np.clip(opacity, 0.0, 1.0)
        found = [self._missing(channel), *(_equals(values, number) for number in holes.numbers)]
        if holes.nan and values.dtype.kind == "f":
            found.append(np.isnan(values))
        for missing in found:
            weights = weights if missing is None else np.where(missing, 0.0, weights)
        return values, weights

    def _chosen(self, channel: OneChannel | None) -> NDArray[Any]:
        """The channel, or all of them where none was asked for and there are several."""
        values = self.values
        if values.ndim != 3 or channel is None or (values.shape[-1] > MAX_COLOURS and not isinstance(channel, Channel)):
            return values
        if self.has_bands and not isinstance(channel, Channel):
            raise ValueError(f"it holds {values.shape[-1]} bands that are no colours; pass channel=Channel(<index>), or save one band.")
        return channel(values)

    def _missing(self, channel: OneChannel | None) -> NDArray[Any] | None:
        """`(ny, nx)`: where a mask or the no-data number says that there is no value; None where nothing does."""
        found: Any = None
        if self.mask is not None:
            found = self.mask if self.mask.ndim == 2 else channel(self.mask) if isinstance(channel, Channel) else self.mask.any(axis=-1)
        if self.nodata is not None:
            is_it = _equals(self.values, self.nodata)
            if is_it.ndim == 3:  # of a colour it is the triple that counts: a blue without red is no hole
                is_it = channel(is_it) if isinstance(channel, Channel) else is_it[..., :3].all(axis=-1)
            found = is_it if found is None else found | is_it
        return found

    def _on_background(self, values: NDArray[Any], channel: OneChannel | None, fill: float | None) -> NDArray[Any]:
        """The channel where it is opaque, `fill` where it is transparent, mixed in between."""
        opacity = self._opacity(channel)
        if opacity is None or (opacity >= 1).all():
            return values
        behind = (1 - opacity) * _wanted(fill, opacity < 1, "is transparent, wholly or partly")
        return np.where(opacity > 0, values if self.is_premultiplied else opacity * values, 0) + behind

    def _opacity(self, channel: OneChannel | None) -> NDArray[Any] | None:
        """`(ny, nx)` from 0 to 1; None where the file has none, or where it is what is asked for."""
        if self.alpha is None or (isinstance(channel, Channel) and channel.index % self.values.shape[-1] == self.alpha):
            return None
        stored = self.values[..., self.alpha]
        return stored / np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else np.asarray(stored, np.float64)


def _wanted(fill: float | None, where: NDArray[Any], reason: str) -> float:
    """The number to put there, or the error that asks for one."""
    if fill is not None:
        return fill
    row, column = (int(i) for i in np.argwhere(where)[0])
    count = f"{int(where.sum())} of {where.size} pixels"
    raise ValueError(
        f"pixel [{row}, {column}] {reason}, so it has no value of its own ({count}); say what stands there by fill=<number> "
        "(--fill of the command), or take it as a hole by holes=Holes() (--holes)."
    )


def _equals(values: NDArray[Any], nodata: float) -> NDArray[Any]:
    """Where values are the no-data number, as their own type holds it."""
    if np.isnan(nodata):
        return np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.shape, bool)
    if values.dtype.kind != "f":  # a number that the type cannot hold is nowhere
        return values == (int(nodata) if float(nodata).is_integer() else nodata)
    if values.dtype.itemsize == 4 and abs(nodata) >= _BEYOND:
        return values * np.sign(nodata) >= _BEYOND
    return values == values.dtype.type(nodata)
