"""A geo-referenced picture in a file that GDAL reads: GeoTIFF, VRT, MBTiles and others."""

import warnings
from pathlib import Path

import numpy as np

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.mapmaking.gdal import ColorInterp, NotGeoreferencedWarning, RasterioError, Resampling, Window, rasterio

_DTYPES = ("uint8", "uint16")
_COLOURS = (ColorInterp.blue, ColorInterp.green, ColorInterp.red)
# A file of 16 bits is made 8 by one scale, from these percentiles of windows that are spread over it.
_PERCENTILES = (2, 98)
_WINDOWS, _WINDOW_PX = 12, 64


class GeoRaster:
    """An open raster. `crs` is its coordinate system, `transform` leads from column and row (of the corners of pixels)
    to its coordinates, `width` and `height` are in pixels."""

    def __init__(self, path: Path) -> None:
        """Open a file. Raises SourceError for one that is no picture or has no geo-reference."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                self._data = rasterio.open(path)
        except (RasterioError, OSError) as error:
            raise SourceError(
                f"{path} cannot be opened as an orthophoto: give a GeoTIFF, VRT or MBTiles file, or a folder of tiles "
                "(z/x/y.png or .jpg)."
            ) from error
        self._path = path
        self.crs, self.transform = self._data.crs, self._data.transform
        self.width, self.height = self._data.width, self._data.height
        try:
            self._bands = self._colour_bands()
            self._tone = self._find_tone() if self._data.dtypes[self._bands[0] - 1] == "uint16" else None
        except BaseException:
            self.close()
            raise

    def _colour_bands(self) -> list[int]:
        """Return the numbers of the bands blue, green and red, or that of grey; refuse what is no picture."""
        kinds, dtypes = self._data.colorinterp, self._data.dtypes
        if not self.crs or self.transform.is_identity:
            raise SourceError(
                f"{self._path} has no geo-reference (coordinate system and position): export it as GeoTIFF with one."
            )
        if ColorInterp.palette in kinds:
            raise SourceError(
                f"{self._path} holds numbers of a palette: make colours of them with `gdal_translate -expand rgb`."
            )
        colours = [kinds.index(colour) + 1 for colour in _COLOURS if colour in kinds]
        others = [number for number, kind in enumerate(kinds, start=1) if kind != ColorInterp.alpha]
        if len(colours) < 3:
            colours = others[2::-1] if len(others) >= 3 else others[:1]
        if not colours or any(dtypes[band - 1] not in _DTYPES for band in colours):
            raise SourceError(
                f"{self._path} holds {dtypes[0]} numbers, such as heights or measurements, and no picture: give an "
                "orthophoto of 8 or 16 bits (unsigned)."
            )
        return colours

    def _find_tone(self) -> np.ndarray:
        """Return the 8-bit value of each 16-bit value, uint8 (65536,)."""
        values = []
        for top in np.linspace(0, max(0, self.height - _WINDOW_PX), _WINDOWS).astype(int):
            for left in np.linspace(0, max(0, self.width - _WINDOW_PX), _WINDOWS).astype(int):
                window = Window(left, top, min(_WINDOW_PX, self.width), min(_WINDOW_PX, self.height))
                values.append(self._read(window, (window.height, window.width)))
        seen = np.concatenate([bands[:, valid].ravel() for bands, valid in values])
        low, high = np.percentile(seen, _PERCENTILES) if len(seen) else (0, 65535)
        return np.clip((np.arange(65536) - low) * (255 / max(high - low, 1)), 0, 255).round().astype(np.uint8)

    def read(self, left: int, top: int, right: int, bottom: int, shrink: int) -> tuple[np.ndarray, np.ndarray]:
        """Read the window from column `left` and row `top` to `right` and `bottom` (not included), whose sides are
        multiples of `shrink`, each `shrink` x `shrink` pixels as their mean.

        Returns uint8 (H, W, 3) BGR, and bool (H, W), True where there is data. Raises ImageError for a damaged window.
        """
        shape = (bottom - top) // shrink, (right - left) // shrink
        bands, valid = self._read(Window(left, top, right - left, bottom - top), shape)
        if self._tone is not None:
            bands = self._tone[bands]
        return np.ascontiguousarray(np.broadcast_to(bands.transpose(1, 2, 0), (*shape, 3))), valid

    def _read(self, window: Window, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        try:
            bands = self._data.read(
                self._bands, window=window, out_shape=(len(self._bands), *shape), resampling=Resampling.average
            )
            return bands, self._data.dataset_mask(window=window, out_shape=shape) > 127
        except RasterioError as error:
            raise ImageError(
                f"{self._path}: the part from column {window.col_off} and row {window.row_off} on cannot be read "
                f"({error}): copy the file again."
            ) from error

    def close(self) -> None:
        """Close the file."""
        self._data.close()
